"""Calls from the appliance to nodes that come from a master: each node has a queue of its own, in order.

A node that is slow or gone delays nobody else; ROSMaster's threads are answered before a node is called. Several
lists of publishers for one topic are all delivered, because roscpp must see a removal before the addition that
follows it. A call that fails is tried again a few times; then it is dropped, and `troubled` hears of it: the node is
looked at, and told what it has missed when it answers (`Liveness.missed`).
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from appliance.master.client import CallFailedError, XmlRpcClient
from appliance.master.registry import Incarnation
from appliance.ros.xmlrpc import FaultReceived, Limits, Value

_log = structlog.get_logger()
MASTER_NAME = "/master"
_CALL_BYTES = 200  # a call with nothing in it, and a text with nothing in it, as Python keeps them
_TEXT_BYTES = 60


@dataclass(frozen=True, slots=True)
class NodeCall:
    """One call to a node: method and parameters after the caller's name.

    `size` is about how many bytes it takes, where that is known; a list of publishers is measured here.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        """About how many bytes it takes while it waits."""
        if self.size:
            return self.size
        texts = [one for given in self.parameters for one in (given if isinstance(given, list) else [given])]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(one) for one in texts if isinstance(one, str))


@dataclass(slots=True)
class _Queue:
    """What waits for one node, each call with its weight, and their sum."""

    incarnation: Incarnation
    calls: deque[tuple[NodeCall, int]] = field(default_factory=deque)
    weight: int = 0

    def put(self, call: NodeCall, weight: int) -> None:
        self.calls.append((call, weight))
        self.weight += weight

    def take(self) -> tuple[NodeCall, int]:
        call, weight = self.calls.popleft()
        self.weight -= weight
        return call, weight


class Delivery:
    """The queues. `timeout` is seconds for one call; `troubled(incarnation, call, why)` hears of a call that is lost.

    A queue holds at most `bound` calls, all together `bound_bytes`: beyond, the oldest go, of the queue that has most.
    """

    def __init__(
        self,
        *,
        timeout: float,
        limits: Limits,
        troubled: Callable[[Incarnation, NodeCall, str], None],
        bound: int = 10_000,
        bound_bytes: int = 64 << 20,
        tries: int = 4,
    ) -> None:
        self._timeout = timeout
        self._limits = limits
        self._troubled = troubled
        self._bound = bound
        self._bound_bytes = bound_bytes
        self._weight = 0  # of all queues
        self._tries = tries
        self._queues: dict[str, _Queue] = {}
        self._workers: dict[str, asyncio.Task[None]] = {}

    @property
    def waiting(self) -> int:
        """How many calls wait, for all nodes together."""
        return sum(len(queue.calls) for queue in self._queues.values())

    @property
    def weight(self) -> int:
        """About how many bytes they take."""
        return self._weight

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        """Queue a call for a node."""
        queue = self._queues.setdefault(incarnation.key, _Queue(incarnation))
        weight = call.weight
        queue.put(call, weight)
        self._weight += weight
        if len(queue.calls) > self._bound:
            self._lose(queue, f"more than {self._bound} calls wait for it")
        while self._weight > self._bound_bytes:
            heaviest = max(self._queues.values(), key=lambda one: one.weight)
            self._lose(
                heaviest, f"calls that wait take more than {self._bound_bytes} bytes, most for this node"
            )
        if incarnation.key not in self._workers:
            worker = asyncio.get_running_loop().create_task(self._work(incarnation))
            self._workers[incarnation.key] = worker

    def drop(self, incarnation: Incarnation) -> None:
        """Forget what waits for a node."""
        queue = self._queues.pop(incarnation.key, None)
        if queue is not None:
            self._weight -= queue.weight

    def _lose(self, queue: _Queue, why: str) -> None:
        self._troubled(queue.incarnation, self._take(queue), f"{why}; the oldest was dropped")

    def _take(self, queue: _Queue) -> NodeCall:
        call, weight = queue.take()
        self._weight -= weight
        return call

    def close(self) -> None:
        """Stop delivering."""
        for worker in self._workers.values():
            worker.cancel()

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """A client that calls the node at its peer address."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=self._limits)

    async def _work(self, incarnation: Incarnation) -> None:
        try:
            while (queue := self._queues.get(incarnation.key)) is not None and queue.calls:
                await self._deliver(incarnation, self._take(queue))
            self._queues.pop(incarnation.key, None)
        finally:
            self._workers.pop(incarnation.key, None)

    async def _deliver(self, incarnation: Incarnation, call: NodeCall) -> None:
        pause = 0.1
        for attempt in range(self._tries):
            try:
                await self.client(incarnation).call(call.method, MASTER_NAME, *call.parameters)
            except CallFailedError as error:
                failure, heard = str(error), isinstance(error.__cause__, FaultReceived)
                if call.method == "shutdown":
                    return  # a node told to shut down often dies before it answers: that is success
            else:
                return
            if attempt + 1 < self._tries:
                await asyncio.sleep(pause)
                pause *= 3
        if heard:
            _log.info("a node refused what it was told", node=incarnation.name, call=call.method, why=failure)
        else:
            self._troubled(incarnation, call, failure)
