"""What ROSMaster is told when a node is gone or may not have something any more; and what it knows services by."""

from collections.abc import Iterable

from appliance.master.graph.registry import Incarnation, Kind, Life, Registration
from appliance.master.reach.faces import Faces
from appliance.master.rosmaster import RosMaster
from appliance.ros.uris import service_uri

CALLS = {
    Kind.PUBLICATION: ("registerPublisher", "unregisterPublisher"),
    Kind.SUBSCRIPTION: ("registerSubscriber", "unregisterSubscriber"),
    Kind.SERVICE: ("registerService", "unregisterService"),
    Kind.PARAMETER: ("subscribeParam", "unsubscribeParam"),
}
"""The calls of the Master API by which a node has something of a kind, and gives it up."""

NO_SERVICE = "rosrpc://nobody:1"
"""A stand-in that is nobody's."""


class Registrar:
    """Unregisters at ROSMaster for nodes."""

    def __init__(self, rosmaster: RosMaster, faces: Faces) -> None:
        self._rosmaster = rosmaster
        self._faces = faces

    async def withdraw(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        """This node does not have this any more."""
        told = [
            resource,
            stand_in(incarnation) if kind is Kind.SERVICE else self._faces.inner_uri(incarnation),
        ]
        if kind is Kind.PARAMETER:  # the one call that has them the other way round
            told.reverse()
        await self._rosmaster.call(CALLS[kind][1], incarnation.name, *told)

    async def withdraw_lost(self, incarnation: Incarnation, registrations: Iterable[Registration]) -> None:
        """Unregister what a lost node had; what is left of it stays when it comes back meanwhile."""
        for one in registrations:
            if incarnation.life is Life.LIVE:
                return
            await self.withdraw(incarnation, one.kind, one.resource)


def stand_in(incarnation: Incarnation) -> str:
    """The service URI that ROSMaster has for every service of an incarnation; nobody is ever told it."""
    return service_uri(incarnation.key, incarnation.relay_port)


def key_of_stand_in(uri: str) -> str:
    """The key of the incarnation behind a stand-in."""
    return uri.removeprefix("rosrpc://").partition(":")[0]
