"""Answer questions of features about a node's machine, and about the publishers that it is connected to."""

import ipaddress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from appliance.control.links.supervisor_link import Surroundings
from appliance.master.endpoints.delivery import Delivery
from appliance.master.graph.registry import Incarnation, Registry
from appliance.rpc.xmlrpc_client import CallFailedError

_LINK_BITS = {4: 30, 6: 126}  # of the link between the appliance's namespace and its machine
_MAX_NAMED = 10


@dataclass(frozen=True)
class NodeConnections:
    """The machines and connections of nodes, as the graph and the nodes themselves report them."""

    registry: Registry
    delivery: Delivery
    surroundings: Surroundings

    def is_here(self, host: str) -> bool | None:
        """Return whether a host is the appliance's machine; None if an appliance in a container cannot know it."""
        address, own = ipaddress.ip_address(host), urlsplit(self.surroundings.master).hostname or ""
        if address.is_loopback or host == own:
            return True
        isolation = self.surroundings.firewall.isolation
        if isolation == "netns" and own:  # the machine has the other address of the link
            return address in ipaddress.ip_network(
                f"{own}/{_LINK_BITS[ipaddress.ip_address(own).version]}", strict=False
            )
        return None if isolation == "container" else False

    async def unknown_publishers(self, node: str, topic: str) -> list[str] | None:
        """Ask a node for its connections, and return the URIs of its publishers that the appliance did not give it.

        The result is null if the node gives no usable answer.
        """
        incarnation = self.registry.holder(node)
        if incarnation is None:
            return None
        known = self._given(incarnation, topic)
        try:
            rows = _rows(await self.delivery.ask(incarnation, "getBusInfo"))
        except CallFailedError:
            return None
        if rows is None:
            return None
        known |= self._given(incarnation, topic)  # it may have changed in the meantime
        sources = (str(row[1]) for row in rows if row[2] == "i" and row[4] == topic)
        return sorted({uri[:200] for uri in sources if _end_of(uri) not in known})[:_MAX_NAMED]

    def _given(self, incarnation: Incarnation, topic: str) -> set[tuple[str | None, int | None]]:
        return {_end_of(uri) for uri in self.delivery.list_of(incarnation, topic) or ()}


def _rows(answer: Any) -> list[Any] | None:
    match answer:
        case [1, _, [*rows]] if all(isinstance(row, list) and len(row) >= 5 for row in rows):
            return rows
    return None


def _end_of(uri: str) -> tuple[str | None, int | None]:
    try:
        parts = urlsplit(uri)
        return parts.hostname, parts.port
    except ValueError:
        return None, None
