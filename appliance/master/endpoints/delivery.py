"""Deliver the calls that nodes expect from a master. A slow or dead node does not delay other nodes.

Every list of publishers is delivered, even if a newer list waits, because roscpp must see a removal before the
following addition. The two are some time apart, because rospy uses only the last of lists that arrive together, and
takes an ending connection for a present one. Calls about other topics overtake a list that waits for this reason.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from appliance.base import clock
from appliance.master.endpoints.node_api import NodeApiClient
from appliance.master.graph.registry import Incarnation
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import NODE_CALLS_UNDER_WAY, QUEUED_NODE_CALLS
from appliance.rpc.fair_queue import Turns
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import FaultReceived, Value

_log = structlog.get_logger()
MASTER_NAME = "/master"
_APART_SECONDS = 0.3  # between a list that removes a publisher and a list that adds it
_LISTS = "publisherUpdate"
_SHORTEST_WAIT = 0.001  # seconds: a timer that ends a little early does not make the worker spin
_CALL_BYTES = 200  # an empty call in Python's memory
_TEXT_BYTES = 60  # an empty text in Python's memory


@dataclass(frozen=True, slots=True)
class NodeCall:
    """A method, and the parameters after the caller's name.

    `size` is the approximate size of the call in bytes, if known.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        if self.size:
            return self.size
        texts = [
            text for given in self.parameters for text in (given if isinstance(given, list) else [given])
        ]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(text) for text in texts if isinstance(text, str))


@dataclass(slots=True)
class _DeliveredList:
    """The last delivered list of a topic; the `removed` publishers are not added before `free`."""

    publishers: frozenset[object] | None = (
        None  # None: unknown; the answer to the registration had the first list
    )
    removed: frozenset[object] | None = frozenset()  # None: all
    free: float = 0.0

    def follow(self, publishers: frozenset[object]) -> None:
        now = clock.now()
        if now >= self.free:
            self.removed = frozenset()
        if self.publishers is None and not publishers:
            self.removed, self.free = None, now + _APART_SECONDS
        elif self.publishers is not None and (gone := self.publishers - publishers):
            self.removed = None if self.removed is None else self.removed | gone
            self.free = now + _APART_SECONDS
        self.publishers = publishers

    def wait(self, publishers: frozenset[object]) -> float:
        adds = publishers if self.removed is None else self.removed & publishers
        return max(0.0, self.free - clock.now()) if adds else 0.0


@dataclass(slots=True)
class _Queue:
    """The waiting calls for a node with their weights, and the sum of these weights."""

    incarnation: Incarnation
    calls: deque[tuple[NodeCall, int]] = field(default_factory=deque)
    weight: int = 0

    def put(self, call: NodeCall, weight: int) -> None:
        self.calls.append((call, weight))
        self.weight += weight

    def take(self, position: int = 0) -> tuple[NodeCall, int]:
        call, weight = self.calls[position]
        del self.calls[position]
        self.weight -= weight
        return call, weight


class Delivery:
    """The queues of calls, one for each node. `troubled` is called for each call that is lost after some attempts.

    A queue holds at most `bound` calls, and `queued` limits the bytes of each host and of all hosts. Beyond a limit,
    an oldest call is dropped. Hosts take turns for the calls under way (`at_once`), so hanging nodes of one host do
    not delay calls to others.
    """

    def __init__(
        self,
        nodes: NodeApiClient,
        *,
        troubled: Callable[[Incarnation, NodeCall, str], None],
        quota_class: Callable[[Address], QuotaClass],
        bound: int = 10_000,
        queued: Bounds = QUEUED_NODE_CALLS.bounds,
        at_once: Bounds = NODE_CALLS_UNDER_WAY.bounds,
        tries: int = 4,
    ) -> None:
        self._nodes = nodes
        self._troubled = troubled
        self._bound = bound
        self._held: Pool[Address] = Pool(
            "bytes of calls that wait for nodes",
            queued,
            lambda _host: QuotaClass.REGISTERED,  # only registered nodes get calls
        )
        self._turns = Turns(at_once, quota_class)
        self._tries = tries
        self._queues: dict[str, _Queue] = {}
        self._workers: dict[str, asyncio.Task[None]] = {}
        self._lists: dict[str, dict[str, _DeliveredList]] = {}  # by node and topic

    @property
    def waiting(self) -> int:
        return sum(len(queue.calls) for queue in self._queues.values())

    @property
    def weight(self) -> int:
        return self._held.total

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        queue = self._queues.setdefault(incarnation.key, _Queue(incarnation))
        weight = call.weight
        queue.put(call, weight)
        self._held.charge(incarnation.host, weight)
        if len(queue.calls) > self._bound:
            self._lose(queue, f"more than {self._bound} calls wait for it")
        while why := self._held.refusal(incarnation.host, 0):
            self._lose(self._heaviest(incarnation.host), why)
        if incarnation.key not in self._workers:
            worker = asyncio.get_running_loop().create_task(self._work(incarnation))
            self._workers[incarnation.key] = worker

    def drop(self, incarnation: Incarnation) -> None:
        self._lists.pop(incarnation.key, None)
        queue = self._queues.pop(incarnation.key, None)
        if queue is not None:
            self._held.give_back(incarnation.host, queue.weight)

    def _heaviest(self, host: Address) -> _Queue:
        if self._held.held(host) <= self._held.bounds.host:
            host, _ = max(self._held.holders(), key=lambda holder: holder[1])
        queues = (queue for queue in self._queues.values() if queue.incarnation.host == host)
        return max(queues, key=lambda queue: queue.weight)

    def _lose(self, queue: _Queue, why: str) -> None:
        self._troubled(queue.incarnation, self._take(queue), f"{why}; the oldest was dropped")

    def _next(self, queue: _Queue) -> tuple[int, float]:
        lists = self._lists.get(queue.incarnation.key, {})
        waits: dict[str, tuple[int, float]] = {}
        for position, (call, _weight) in enumerate(queue.calls):
            topic = str(call.parameters[0]) if call.method == _LISTS else ""
            if topic in waits:
                continue
            delivered = lists.get(topic)
            seconds = delivered.wait(_publishers(call)) if delivered is not None else 0.0
            if not seconds:
                return position, 0.0
            waits[topic] = position, seconds
        return min(waits.values(), key=lambda wait: wait[1])

    def _take(self, queue: _Queue, position: int = 0) -> NodeCall:
        call, weight = queue.take(position)
        self._held.give_back(queue.incarnation.host, weight)
        return call

    def close(self) -> None:
        for worker in self._workers.values():
            worker.cancel()

    async def _work(self, incarnation: Incarnation) -> None:
        try:
            while (queue := self._queues.get(incarnation.key)) is not None and queue.calls:
                position, seconds = self._next(queue)
                if seconds:
                    await asyncio.sleep(max(seconds, _SHORTEST_WAIT))
                    continue
                call = self._take(queue, position)
                await self._deliver(incarnation, call)
                if call.method == _LISTS:
                    lists = self._lists.setdefault(incarnation.key, {})
                    lists.setdefault(str(call.parameters[0]), _DeliveredList()).follow(_publishers(call))
            self._queues.pop(incarnation.key, None)
        finally:
            self._workers.pop(incarnation.key, None)

    async def _deliver(self, incarnation: Incarnation, call: NodeCall) -> None:
        pause = 0.1
        for attempt in range(self._tries):
            await self._turns.enter(incarnation.host)
            try:
                await self._nodes.call(incarnation, call.method, MASTER_NAME, *call.parameters)
            except CallFailedError as error:
                failure, heard = str(error), isinstance(error.__cause__, FaultReceived)
                if call.method == "shutdown":
                    return  # a successful shutdown: a node often dies before it answers, or was already dead
            else:
                return
            finally:
                self._turns.leave(incarnation.host)
            if attempt + 1 < self._tries:
                await asyncio.sleep(pause)
                pause *= 3
        if heard:
            _log.info("a node rejected a call", node=incarnation.name, call=call.method, why=failure)
        else:
            self._troubled(incarnation, call, failure)


def _publishers(call: NodeCall) -> frozenset[object]:
    publishers = call.parameters[1] if call.method == _LISTS else ()
    return frozenset(publishers if isinstance(publishers, list) else ())
