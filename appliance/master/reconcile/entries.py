"""Make, end and restore registrations at the hidden ROS master, with the node's inner URI.

Services are registered with a stand-in URI. Clients never get this URI.
"""

from collections.abc import Callable, Iterable

from appliance.master.caller import Answer
from appliance.master.graph.registry import Incarnation, Kind, Life, NodeRegistration
from appliance.master.graph.revocation import CALLS
from appliance.master.rosmaster import RosMaster, together
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import service_uri
from roswire.xmlrpc import Value

NAME = "/master"
NO_SERVICE = "rosrpc://nobody:1"
"""The stand-in URI if no node is known."""


class MasterRegistrations:
    """The registrations at the ROS master. `inner_uri(node)` returns the URI by which the ROS master knows a node.

    `pid` is the process id of the ROS master that has all registrations. It is None before the first such process.
    """

    def __init__(self, rosmaster: RosMaster, inner_uri: Callable[[Incarnation], str]) -> None:
        self._rosmaster = rosmaster
        self._inner_uri = inner_uri
        self.pid: int | None = None

    async def make(self, node: Incarnation, registration: NodeRegistration) -> Answer:
        """Make a registration of a node, even while the door is shut."""
        name, inner, resource = node.name, self._inner_uri(node), registration.resource
        told = {
            Kind.PUBLICATION: (resource, registration.detail, inner),
            Kind.SUBSCRIPTION: (resource, registration.detail, inner),
            Kind.SERVICE: (resource, stand_in(node), inner),
            Kind.PARAMETER: (inner, resource),
        }[registration.kind]
        return await self._rosmaster.call_now(CALLS[registration.kind][0], name, *told)

    async def end(self, node: Incarnation, kind: Kind, resource: str) -> None:
        """End a registration of a node, because the node is gone or may no longer have the registration."""
        told = [resource, stand_in(node) if kind is Kind.SERVICE else self._inner_uri(node)]
        if kind is Kind.PARAMETER:  # only this call has the reverse order
            told.reverse()
        await self._rosmaster.call(CALLS[kind][1], node.name, *told)

    async def end_lost(self, node: Incarnation, registrations: Iterable[NodeRegistration]) -> None:
        """End the registrations of a lost node one by one. Stop if the node is live again."""
        for registration in registrations:
            if node.life is Life.LIVE:
                return
            await self.end(node, registration.kind, registration.resource)

    async def put_back(
        self, node: Incarnation, registrations: Iterable[NodeRegistration]
    ) -> list[tuple[str, Value]]:
        """Make the former registrations of a returned node again, once the ROS master is reachable.

        Registrations that were withdrawn in the meantime are left out. If the node is no longer live, all are left out,
        because the ROS master would then end the later life of the node.

        Return the parameters that the node subscribed to, with their values: the node missed their changes, and the ROS
        master reports each change only once. Raises `CallFailedError`; the reconcile loop then runs a round.
        """

        async def put(registration: NodeRegistration) -> tuple[str, Value] | None:
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
                    raise CallFailedError(
                        "the ROS master was restarted: the next round registers everything again"
                    )
                values = await together(put(registration) for registration in registrations)
        except CallFailedError:
            self._rosmaster.doubtful.set()
            raise
        return [value for value in values if value is not None]


def stand_in(node: Incarnation) -> str:
    """Return the URI under which the ROS master knows an incarnation's services. Clients never get this URI."""
    return service_uri(node.key, node.relay_port)
