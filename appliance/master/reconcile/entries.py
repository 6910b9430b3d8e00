"""What the hidden ROSMaster has of each node: made, ended and put back under the node's inner URI.

Every service of an incarnation has a stand-in there that nobody is ever told.
"""

from collections.abc import Callable, Iterable

from appliance.master.caller import Answer
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration
from appliance.master.graph.revocation import CALLS
from appliance.master.rosmaster import RosMaster, together
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import service_uri
from roswire.xmlrpc import Value

NAME = "/master"
NO_SERVICE = "rosrpc://nobody:1"
"""A stand-in that is nobody's."""


class Entries:
    """Calls ROSMaster for nodes; `inner_uri(node)` is what ROSMaster knows a node by.

    `pid` is of the ROSMaster that was told everything; None until there was one.
    """

    def __init__(self, rosmaster: RosMaster, inner_uri: Callable[[Incarnation], str]) -> None:
        self._rosmaster = rosmaster
        self._inner_uri = inner_uri
        self.pid: int | None = None

    async def make(self, node: Incarnation, registration: Registration) -> Answer:
        """Register something that a node has, whether or not the door is open."""
        name, inner, resource = node.name, self._inner_uri(node), registration.resource
        told = {
            Kind.PUBLICATION: (resource, registration.detail, inner),
            Kind.SUBSCRIPTION: (resource, registration.detail, inner),
            Kind.SERVICE: (resource, stand_in(node), inner),
            Kind.PARAMETER: (inner, resource),
        }[registration.kind]
        return await self._rosmaster.call_now(CALLS[registration.kind][0], name, *told)

    async def end(self, node: Incarnation, kind: Kind, resource: str) -> None:
        """Unregister something for a node that is gone or may not have it any more."""
        told = [resource, stand_in(node) if kind is Kind.SERVICE else self._inner_uri(node)]
        if kind is Kind.PARAMETER:  # the one call that has them the other way round
            told.reverse()
        await self._rosmaster.call(CALLS[kind][1], node.name, *told)

    async def end_lost(self, node: Incarnation, registrations: Iterable[Registration]) -> None:
        """Unregister what a lost node had; what is left of it stays when it comes back meanwhile."""
        for registration in registrations:
            if node.life is Life.LIVE:
                return
            await self.end(node, registration.kind, registration.resource)

    async def put_back(
        self, node: Incarnation, registrations: Iterable[Registration]
    ) -> list[tuple[str, Value]]:
        """Register what a returned node had, as far as it still has it when ROSMaster can be told.

        What was taken from it meanwhile is left out; and an earlier life of a node would have ROSMaster end the later.
        Returns the parameters it subscribed to with their values: it heard of no change in the meantime, and ROSMaster
        tells each change once. Raises `CallFailedError`, and then a round of the reconcile loop is due.
        """

        async def put(registration: Registration) -> tuple[str, Value] | None:
            if (
                node.life is not Life.LIVE
                or (registration.kind, registration.resource) not in node.registrations
            ):
                return None
            code, _, value = await self.make(node, registration)
            return (
                (registration.resource, value) if registration.kind is Kind.PARAMETER and code == 1 else None
            )

        try:
            async with self._rosmaster.alone():
                if (await self._rosmaster.call_now("getPid", NAME))[2] != self.pid:
                    raise CallFailedError("the ROS Master is new: the next round tells it everything")
                values = await together(put(registration) for registration in registrations)
        except CallFailedError:
            self._rosmaster.doubtful.set()
            raise
        return [value for value in values if value is not None]


def stand_in(node: Incarnation) -> str:
    """The service URI that ROSMaster has for every service of an incarnation; nobody is ever told it."""
    return service_uri(node.key, node.relay_port)
