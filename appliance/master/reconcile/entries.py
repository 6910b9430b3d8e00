"""Forward the changes of the registry to the hidden ROS master, in order, behind the answers to nodes.

A registering call is answered from the registry, once the change is stored. The ROS master gets the change afterwards,
with the node's inner URI; services get a stand-in URI. Clients never get these URIs. Invariants:

1. No answer to a node depends on a forwarded change. All reads of the graph are answered from the registry.
2. The ROS master gets the changes in the order of the registry. One request is under way at a time.
3. A round of the reconcile loop compares the ROS master with the registry. The changes that waited then are part of the
   registry, so they are dropped (`start_round`). Later changes follow after the round.
4. A change that fails is not repeated. It shuts the door, and the next round removes the difference. The same holds
   after the death of control: its registry is stored.
5. At most `MASTER_CHANGES` wait (`quotas.table`). Beyond that, registering calls of the host wait (`room`). Changes
   that no node called for, such as a revocation, do not wait.
"""

import asyncio
from collections import Counter, deque
from collections.abc import Callable

import structlog

from appliance.master.graph.registry import Incarnation, Kind, NodeRegistration, Registry
from appliance.master.graph.revocation import CALLS
from appliance.master.rosmaster import LARGEST_MULTICALL, RosMaster, Wanted
from appliance.policy.model import Address
from appliance.quotas.table import MASTER_CHANGES
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.uris import service_uri

NAME = "/master"
_GATHER_SECONDS = 0.1  # gathered changes cost half the processor time

_log = structlog.get_logger()


class MasterRegistrations:
    """The registrations at the ROS master. `inner_uri(node)` returns the URI by which the ROS master knows a node.

    `pid` is the process id of the ROS master that has all registrations. It is None before the first such process.
    """

    def __init__(
        self, rosmaster: RosMaster, registry: Registry, inner_uri: Callable[[Incarnation], str]
    ) -> None:
        self._rosmaster = rosmaster
        self._registry = registry
        self._inner_uri = inner_uri
        self._waiting: deque[tuple[Address, Wanted]] = deque()  # each with the host of its node
        self._waiting_of: Counter[Address] = Counter()
        self._sending: asyncio.Task[None] | None = None
        self._has_room = asyncio.Event()
        self.pid: int | None = None

    def make(self, node: Incarnation, registration: NodeRegistration) -> None:
        self._forward(node.host, self.call_to_make(node, registration))

    def end(self, node: Incarnation, registration: NodeRegistration) -> None:
        kind, resource = registration.kind, registration.resource
        told = [resource, stand_in(node) if kind is Kind.SERVICE else self._inner_uri(node)]
        if kind is Kind.PARAMETER:  # only this call has the reverse order
            told.reverse()
        self._forward(node.host, (CALLS[kind][1], (node.name, *told)))

    async def room(self, host: Address) -> None:
        """Wait until the queue has room for a change of a host. Raises `CallFailedError` after a long wait."""
        if not self._is_full(host):
            return
        async with self._rosmaster.patience():
            while self._is_full(host):
                self._has_room.clear()
                await self._has_room.wait()

    def start_round(self) -> list[tuple[Incarnation, NodeRegistration]]:
        """Return the registrations that the ROS master must have, in order; drop the changes that led to them."""
        self._waiting.clear()
        self._waiting_of.clear()
        self._has_room.set()
        return list(self._registry.in_order())

    def call_to_make(self, node: Incarnation, registration: NodeRegistration) -> Wanted:
        inner, resource = self._inner_uri(node), registration.resource
        told = {
            Kind.PUBLICATION: (resource, registration.detail, inner),
            Kind.SUBSCRIPTION: (resource, registration.detail, inner),
            Kind.SERVICE: (resource, stand_in(node), inner),
            Kind.PARAMETER: (inner, resource),
        }[registration.kind]
        return CALLS[registration.kind][0], (node.name, *told)

    def _is_full(self, host: Address) -> bool:
        bounds = MASTER_CHANGES.bounds
        return len(self._waiting) >= bounds.whole or self._waiting_of[host] >= bounds.host

    def _forward(self, host: Address, call: Wanted) -> None:
        self._waiting.append((host, call))
        self._waiting_of[host] += 1
        if self._sending is None or self._sending.done():
            self._sending = asyncio.get_running_loop().create_task(self._send())

    async def _send(self) -> None:
        while self._waiting:
            if len(self._waiting) < LARGEST_MULTICALL:
                await asyncio.sleep(_GATHER_SECONDS)
            await self._rosmaster.opened()
            taken = [self._waiting.popleft() for _ in range(min(len(self._waiting), LARGEST_MULTICALL))]
            self._waiting_of -= Counter(host for host, _call in taken)  # removes hosts without changes
            self._has_room.set()
            part = [call for _host, call in taken]
            try:
                answers = await self._rosmaster.call_once(part)
            except CallFailedError as error:
                _log.warning("changes did not reach the ROS master", number=len(part), error=str(error))
                continue
            for (method, params), answer in zip(part, answers, strict=True):
                if isinstance(answer, CallFailedError) or answer[0] != 1:
                    _log.error(
                        "the ROS master rejected a change", call=method, of=params[:2], answer=str(answer)
                    )
                    self._rosmaster.doubtful.set()


def stand_in(node: Incarnation) -> str:
    """Return the URI under which the ROS master knows an incarnation's services. Clients never get this URI."""
    return service_uri(node.key, node.relay_port)
