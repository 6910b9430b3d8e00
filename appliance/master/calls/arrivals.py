"""Find or make the incarnation of a registering call, by its name, host and API URI.

multimaster_fkie registers the nodes of other machines, which cannot be called at their caller's address. A node on a
machine with several addresses may also name another host. So the port of such a new node must be open at the caller's
address, as every node's port is before it registers.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.master.calls.call import ApiUri, Caller
from appliance.master.endpoints.node_ports import AdvertisedAddresses, NodePorts, NoPortError
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Life, Registry, new_key
from appliance.master.reconcile.liveness import Liveness
from appliance.master.reconcile.sinks import ProxyEndpoints
from appliance.policy.model import Address
from appliance.rpc.server import Handler

_CONNECT_SECONDS = 1.0

ServeNode = Callable[[Incarnation], Handler]
"""Makes the handler of a node's proxy endpoint."""


class NodeElsewhereError(Exception):
    """The registered node does not run on the caller's host; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Finds or makes the incarnations of callers."""

    registry: Registry
    graph: RosGraph
    flush: Callable[[], None]
    liveness: Liveness
    places: NodePorts
    faces: ProxyEndpoints
    addresses: AdvertisedAddresses
    serve: ServeNode

    def known(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        return self.registry.find(caller.caller_id, caller.peer.host, api.text)

    async def incarnation_for(self, caller: Caller, api: ApiUri) -> Incarnation:
        """Return the calling incarnation; an unknown caller gets a new one with ports.

        Raises `HostFullError`, `NoPortError`, or `NodeElsewhereError`; then no incarnation is made.
        """
        identity = (caller.caller_id, caller.peer.host, api.text)
        incarnation = self.registry.find(*identity)
        if incarnation is not None and incarnation.life is Life.SHADOW:
            if self.registry.holder(incarnation.name) is None:
                self.liveness.revive(incarnation)  # before a check has found that the node is back
            else:  # another incarnation took the name in the meantime, so this node starts as a new incarnation
                self.graph.forgotten(incarnation)
        if incarnation is not None and incarnation.life is Life.LIVE:
            incarnation.touched = clock.now()
            self.registry.reached_at(incarnation, self.addresses.address_for(caller.peer))
            return incarnation
        incarnation = self._make(caller, api)
        incarnation.calls += 1
        try:
            await self.faces.open(incarnation, self.serve(incarnation))
            await self._check_place(caller, incarnation)
        except (NoPortError, NodeElsewhereError):
            self.graph.forgotten(incarnation)
            raise
        finally:
            incarnation.calls -= 1
        return incarnation

    async def _check_place(self, caller: Caller, incarnation: Incarnation) -> None:
        if caller.own or incarnation.api.host == caller.peer.text:
            return
        if await self.liveness.nodes.client(incarnation).refuses(_CONNECT_SECONDS):
            raise NodeElsewhereError(
                f"{caller.peer.text} registers {caller.caller_id} at {incarnation.api_text[:80]}, but has no node on "
                f"port {incarnation.api.port}: a node registers from its own machine; nodes of other masters "
                "(multimaster_fkie) cannot be registered here: start them with this master's ROS_MASTER_URI"
            )

    def _make(self, caller: Caller, api: ApiUri) -> Incarnation:
        identity = (caller.caller_id, caller.peer.host, api.text)
        if not caller.own and (evicted := self.registry.room_for(*identity)) is not None:
            self.graph.forgotten(evicted)
        outer_port, relay_port, *more = self._open_ports(caller.peer.host)
        incarnation = Incarnation(
            key=new_key(),
            name=caller.caller_id,
            host=caller.peer.host,
            api=api.uri,
            api_text=api.text,
            told=self.addresses.address_for(caller.peer),
            outer_port=outer_port,
            relay_port=relay_port,
            more_relay_ports=tuple(more),
            own=caller.own,
            changed=clock.now(),
            touched=clock.now(),
        )
        self.registry.add(incarnation)
        return incarnation

    def _open_ports(self, host: Address) -> tuple[int, ...]:
        while True:
            self.flush()  # closes the ports of forgotten nodes
            try:
                return self.places.open(host)
            except NoPortError:
                evicted = self.registry.evictable_for(host)
                if evicted is None:
                    raise
                self.graph.forgotten(evicted)
