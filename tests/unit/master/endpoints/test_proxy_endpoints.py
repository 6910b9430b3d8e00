import ipaddress
from typing import Any, cast

from appliance.master.graph.registry import Incarnation
from appliance.master.reconcile.sinks import ProxyEndpoints
from roswire.uris import parse_node_uri


class Told:
    def __init__(self) -> None:
        self.calls: list[tuple[str, Any]] = []

    def close(self, *given: Any) -> None:
        self.calls.append(("close", given))


def test_ports_are_closed_once() -> None:
    """A node is closed when it is replaced, and again when it is forgotten: then another node may have its ports."""
    places, server = Told(), Told()
    faces = ProxyEndpoints(cast(Any, None), cast(Any, places), *[cast(Any, None)] * 2)
    faces.servers["key"] = cast(Any, server)
    uri = "http://10.0.0.5:4000/"
    host = ipaddress.ip_address("10.0.0.5")
    node = Incarnation("key", "/node", host, parse_node_uri(uri), uri, "10.0.0.1", 19001, 19002)
    faces.close(node)
    faces.close(node)
    assert places.calls == [("close", (node,))]
    assert server.calls == [("close", ())]
