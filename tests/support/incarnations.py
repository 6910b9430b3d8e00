import ipaddress
from typing import Any

from appliance.master.graph.registry import Incarnation
from roswire.uris import parse_node_uri


def incarnation(
    name: str,
    port: int = 4000,
    *,
    host: str = "10.0.0.5",
    key: str = "",
    ports: tuple[int, ...] = (19001, 19002),
    path: str = "/",
    **more: Any,
) -> Incarnation:
    """Return a node with its API at `port`; its `key` is "key of NAME" unless given."""
    uri = f"http://{host}:{port}{path}"
    address, (outer, relay, *others) = ipaddress.ip_address(host), ports
    return Incarnation(
        key or f"key of {name}", name, address, parse_node_uri(uri), uri, "10.0.0.1", outer, relay,
        more_relay_ports=tuple(others), **more,
    )  # fmt: skip
