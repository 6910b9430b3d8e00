"""Change RVMaster's graph for an adoption: by orders that are decided, charged and recorded like a node's own calls."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

from appliance.features.adopt.places import NodePlace
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import Answer
from appliance.policy.model import Address
from appliance.rpc.master_reader import PUBLICATION, SERVICE, SUBSCRIPTION, Entry, MasterGraph, printable
from appliance.telemetry.audit_trail import AuditTrail
from roswire.names import ROSOUT
from roswire.uris import service_uri
from roswire.xmlrpc import Value

ANY_TYPE = "*"

CLOCK = "/clock"
"""Simulated time. Its subscribers get no new list until their connections have ended: rospy keeps a connection that its
list lacks, and would hear each time twice. Time would go back, at which `rospy.sleep` raises an exception.
"""

_REGISTER = {
    PUBLICATION: "registerPublisher",
    SUBSCRIPTION: "registerSubscriber",
    SERVICE: "registerService",
}
_UNREGISTER = {
    PUBLICATION: "unregisterPublisher",
    SUBSCRIPTION: "unregisterSubscriber",
    SERVICE: "unregisterService",
}


class Order(Protocol):
    """Carries out a call of the Master API as if a node of this host had made it."""

    async def __call__(self, host: Address, method: str, /, *params: Value) -> Answer: ...


@dataclass
class AdoptedGraph:
    """The nodes of the robot in RVMaster's graph. `settle` waits until nodes have the lists that were sent."""

    registry: Registry
    graph: RosGraph
    subscribers: Subscribers
    trail: AuditTrail
    order: Order
    flush: Callable[[], None]
    reserved: frozenset[str] = frozenset({ROSOUT})
    denied: dict[Entry, str] = field(default_factory=dict)
    """Registrations that the policy or a limit denied, with the reason."""

    def is_own(self, name: str) -> bool:
        """Return whether a name belongs to a node of the appliance, such as `/rosout`."""
        holder = self.registry.holder(name)
        return name in self.reserved or (holder is not None and holder.own)

    def has(self, entry: Entry, place: NodePlace) -> bool:
        node = self.node_at(entry[2], place)
        return (
            node is not None and node.life is Life.LIVE and (Kind(entry[0]), entry[1]) in node.registrations
        )

    def node_at(self, name: str, place: NodePlace) -> Incarnation | None:
        return self.registry.find(name, place.host, place.text)

    async def register(self, entry: Entry, place: NodePlace, graph: MasterGraph) -> bool:
        """Register for a node; return whether that was allowed. A registration that exists is left as it is."""
        if self.has(entry, place):
            self._note_unasked(entry, place)  # a kill may have come before that was stored
            return True
        kind, resource, name = entry
        detail: Value = (
            graph.services.get(resource, "") if kind == SERVICE else graph.types.get(resource, ANY_TYPE)
        )
        answer = await self.order(place.host, _REGISTER[kind], name, resource, detail, place.text)
        if answer[0] != 1:
            self.denied[entry] = printable(str(answer[1]))
            return False
        self.denied.pop(entry, None)
        self._note_unasked(entry, place)
        self.trail.happened(
            "adopted",
            f"{name} was registered for {resource} by an operator's order",
            host=str(place.host), caller_id=name, category=kind, resource=resource,
        )  # fmt: skip
        return True

    def _note_unasked(self, entry: Entry, place: NodePlace) -> None:
        node = self.node_at(entry[2], place)
        if node is not None:
            self.subscribers.unasked.add(node)

    async def unregister(self, entry: Entry, place: NodePlace, graph: MasterGraph) -> None:
        kind, resource, name = entry
        detail = graph.services.get(resource, "") if kind == SERVICE else place.text
        self.denied.pop(entry, None)
        await self.order(place.host, _UNREGISTER[kind], name, resource, detail)

    def tell(
        self,
        names: Iterable[str],
        besides: Mapping[str, Iterable[str]] = MappingProxyType({}),
    ) -> None:
        """Send the subscribers of adopted nodes their lists, with the URIs of the appliance; not those of `CLOCK`.

        `besides` has more URIs for topics.
        """
        for name in names:
            node = self.registry.holder(name)
            if node is None:
                continue
            for topic in node.resources(Kind.SUBSCRIPTION):
                if topic == CLOCK:
                    continue
                if topic in besides:
                    self.subscribers.remind_besides(node, topic, besides[topic])
                else:
                    self.subscribers.remind(node, topic)

    def clocks(self, names: Iterable[str]) -> dict[tuple[Incarnation, str], tuple[str, ...]]:
        """Return the lists of the subscribers of `CLOCK` among adopted nodes."""
        nodes = [node for name in names if (node := self.registry.holder(name)) is not None]
        return {
            (node, CLOCK): self.publishers_for(node, CLOCK)
            for node in nodes
            if CLOCK in node.resources(Kind.SUBSCRIPTION)
        }

    def remind(self, node: Incarnation, topic: str) -> None:
        self.subscribers.remind(node, topic)

    def publishers_for(self, node: Incarnation, topic: str) -> tuple[str, ...]:
        """Return the appliance's URIs of a topic's publishers, as a subscriber has them."""
        return self.subscribers.publishers_for(node, topic)

    async def absent(self) -> int:
        """Return the number of subscriptions that are not yet connected through the appliance, without `CLOCK`."""
        return sum(1 for _node, topic, _absent in self.subscribers.absent(self.nodes()) if topic != CLOCK)

    def nodes(self) -> list[Incarnation]:
        """Return the nodes of the robot, also those that the policy or a failure suspended."""
        return [node for node in self.registry.all() if not node.own and node.life is not Life.REPLACED]

    def adopted_nodes(self) -> list[Incarnation]:
        """Return the nodes of the robot that answer, and have a registration."""
        return [node for node in self.nodes() if node.life is Life.LIVE and node.registrations]

    def all_registrations(self) -> Iterator[tuple[Entry, Incarnation]]:
        """Yield all registrations. One that the policy withdrew still exists for its node, and a node that does not
        answer may only be slow.
        """
        for node in sorted(self.nodes(), key=lambda node: node.life is Life.LIVE):
            for kind, resource in (*node.registrations, *node.shelf):
                if kind is not Kind.PARAMETER:
                    yield (kind.value, resource, node.name), node

    def forget(self) -> int:
        """Forget all nodes: they belong to another master."""
        nodes = self.nodes()
        for node in nodes:
            self.subscribers.unasked.discard(node)
            self.graph.forgotten(node)
        self.flush()
        return len(nodes)


def service_text(node: Incarnation, resource: str) -> str:
    """Return the URI of a node's service, with the host that the node itself announces."""
    registration = node.registrations.get((Kind.SERVICE, resource)) or node.shelf[Kind.SERVICE, resource]
    return service_uri(node.api.host, int(registration.detail))
