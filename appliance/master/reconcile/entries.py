"""Make, end and restore registrations at the hidden ROS master, with the node's inner URI.

Services are registered with a stand-in URI, which clients never get.
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
    """The registrations at the ROS master; `inner_uri(node)` is the URI by which it knows a node.

    `pid` is the process id of the ROS master that has all registrations; None before the first one.
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
        """End a registration of a node that is gone or may not have it any more."""
        told = [resource, stand_in(node) if kind is Kind.SERVICE else self._inner_uri(node)]
        if kind is Kind.PARAMETER:  # only this call has the reverse order
            told.reverse()
        await self._rosmaster.call(CALLS[kind][1], node.name, *told)

    async def end_lost(self, node: Incarnation, registrations: Iterable[NodeRegistration]) -> None:
        """End the registrations of a lost node, until it comes back."""
        for registration in registrations:
            if node.life is Life.LIVE:
                return
            await self.end(node, registration.kind, registration.resource)

    async def put_back(
        self, node: Incarnation, registrations: Iterable[NodeRegistration]
    ) -> list[tuple[str, Value]]:
        """Register the former registrations of a returned node, as far as it still has them when the ROS master is
        reachable.

        Registrations that were withdrawn meanwhile are left out, as is an earlier life of a node, because the ROS
        master would end the later one. Return the parameters that the node subscribed to with their values: it missed
        their changes, and the ROS master reports each change once. Raises `CallFailedError`, and then a round of the
        reconcile loop is due.
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
    """Return the service URI under which the ROS master knows an incarnation's services; clients never get it."""
    return service_uri(node.key, node.relay_port)
