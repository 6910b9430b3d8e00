"""How an incarnation comes to be: a call registers under a name, from a host, with an API URI.

Who is coming makes room for nobody: else two that come at once, where there is room for one, would take it from each
other for ever.
"""

import time
from dataclasses import dataclass

from appliance.master.caller import ApiUri, Caller
from appliance.master.endpoints.endpoint_addresses import Addresses, NoPortError, Places
from appliance.master.endpoints.proxy_endpoints import Faces
from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import Incarnation, Life, Registry, new_key
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.liveness import Liveness
from appliance.policy.model import Address


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Finds the incarnation that calls, or makes it."""

    registry: Registry
    graph: Graph
    enactor: Enactor
    liveness: Liveness
    places: Places
    faces: Faces
    addresses: Addresses

    def known(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """The incarnation that calls, if it is known."""
        return self.registry.find(caller.caller_id, caller.peer.host, api.text)

    async def incarnation_for(self, caller: Caller, api: ApiUri) -> Incarnation:
        """The incarnation that calls; made, with its ports and durably, when it is new.

        Raises `NoPortError` when the range of ports is exhausted, or control has no descriptors; nothing stays then.
        """
        identity = (caller.caller_id, caller.peer.host, api.text)
        incarnation = self.registry.find(*identity)
        if incarnation is not None and incarnation.life is Life.LIVE:
            incarnation.touched = time.monotonic()
            incarnation.told = self.addresses.told_to(caller.peer)
            return incarnation
        if incarnation is not None and incarnation.life is Life.SHADOW:
            if self.registry.holder(incarnation.name) is None:
                # It was away and adds to what it had, before anybody saw that it is back.
                with MakingRoomForNobody(incarnation):
                    await self.liveness.revive(incarnation)
                return incarnation
            # Another took its name meanwhile: it begins anew.
            self.enactor.carry_out(self.graph.forgotten(incarnation))
        incarnation = self._make(caller, api)
        try:
            with MakingRoomForNobody(incarnation):
                await self.faces.open(incarnation)
        except NoPortError:
            self.enactor.carry_out(self.graph.forgotten(incarnation))
            raise
        return incarnation

    def _make(self, caller: Caller, api: ApiUri) -> Incarnation:
        outer_port, relay_port, *more = self._open_ports(caller.peer.host)
        incarnation = Incarnation(
            key=new_key(),
            name=caller.caller_id,
            host=caller.peer.host,
            api=api.uri,
            api_text=api.text,
            told=self.addresses.told_to(caller.peer),
            outer_port=outer_port,
            relay_port=relay_port,
            more_relay_ports=tuple(more),
            own=caller.own,
            changed=time.monotonic(),
            touched=time.monotonic(),
        )
        self.enactor.carry_out(self.registry.add(incarnation))
        return incarnation

    def _open_ports(self, host: Address) -> tuple[int, ...]:
        """Ports for a node of this host; who has no registration makes room at once. Raises `NoPortError`."""
        while True:
            try:
                return self.places.open(host)
            except NoPortError:
                spare = self.registry.spare(host)
                if spare is None:
                    raise
                self.enactor.carry_out(self.graph.forgotten(spare))


class MakingRoomForNobody:
    """A registering call of an incarnation is under way."""

    __slots__ = ("_incarnation",)

    def __init__(self, incarnation: Incarnation) -> None:
        self._incarnation = incarnation

    def __enter__(self) -> Incarnation:
        self._incarnation.calls += 1
        return self._incarnation

    def __exit__(self, *_error: object) -> None:
        self._incarnation.calls -= 1
