"""Calls from the appliance to nodes that come from a master: each node has a queue of its own, in order.

A node that is slow or gone delays nobody else; ROSMaster's threads are answered before a node is called. Several
lists of publishers for one topic are all delivered, because roscpp must see a removal before the addition that
follows it. A call that fails is tried again a few times; then the node is looked at (`troubled`).
"""

import asyncio
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import structlog

from appliance.master.client import CallFailedError, XmlRpcClient
from appliance.master.registry import Incarnation
from appliance.ros.xmlrpc import Limits, Value

_log = structlog.get_logger()
MASTER_NAME = "/master"


@dataclass(frozen=True, slots=True)
class NodeCall:
    """One call to a node: method and parameters after the caller's name, and about how many bytes it takes."""

    method: str
    parameters: tuple[Value, ...]
    size: int = 0


class Delivery:
    """The queues. `timeout` is seconds for one call.

    A queue holds at most `bound` calls, all together `bound_bytes`: beyond, the oldest go, of the queue that has most.
    """

    def __init__(
        self,
        *,
        timeout: float,
        limits: Limits,
        troubled: Callable[[Incarnation, str], None],
        bound: int = 10_000,
        bound_bytes: int = 64 << 20,
        tries: int = 4,
    ) -> None:
        self._timeout = timeout
        self._limits = limits
        self._troubled = troubled
        self._bound = bound
        self._bound_bytes = bound_bytes
        self._bytes: Counter[str] = Counter()
        self._bytes_in_all = 0
        self._tries = tries
        self._queues: dict[str, deque[NodeCall]] = {}
        self._workers: dict[str, asyncio.Task[None]] = {}

    @property
    def waiting(self) -> int:
        """How many calls wait, for all nodes together."""
        return sum(map(len, self._queues.values()))

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        """Queue a call for a node."""
        queue = self._queues.setdefault(incarnation.key, deque())
        queue.append(call)
        self._count(incarnation.key, call.size)
        if len(queue) > self._bound:
            self._take(incarnation.key)
            self._troubled(incarnation, f"more than {self._bound} calls wait for it; the oldest was dropped")
        while self._bytes_in_all > self._bound_bytes:
            longest = max(self._bytes, key=lambda key: self._bytes[key])
            self._take(longest)
            _log.warning(
                "calls that wait for a node take too much memory: the oldest is dropped", key=longest
            )
        if incarnation.key not in self._workers:
            worker = asyncio.get_running_loop().create_task(self._work(incarnation))
            self._workers[incarnation.key] = worker

    def drop(self, incarnation: Incarnation) -> None:
        """Forget what waits for a node."""
        while self._queues.get(incarnation.key):
            self._take(incarnation.key)
        self._queues.pop(incarnation.key, None)

    def _take(self, key: str) -> NodeCall:
        call = self._queues[key].popleft()
        self._count(key, -call.size)
        return call

    def _count(self, key: str, size: int) -> None:
        self._bytes_in_all += size
        self._bytes[key] += size
        if not self._bytes[key]:
            del self._bytes[key]

    def close(self) -> None:
        """Stop delivering."""
        for worker in self._workers.values():
            worker.cancel()

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """A client that calls the node at its peer address."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=self._limits)

    async def _work(self, incarnation: Incarnation) -> None:
        try:
            while self._queues.get(incarnation.key):
                await self._deliver(incarnation, self._take(incarnation.key))
            self._queues.pop(incarnation.key, None)
        finally:
            self._workers.pop(incarnation.key, None)

    async def _deliver(self, incarnation: Incarnation, call: NodeCall) -> None:
        pause = 0.1
        for attempt in range(self._tries):
            try:
                await self.client(incarnation).call(call.method, MASTER_NAME, *call.parameters)
            except CallFailedError as error:
                failure = str(error)
                if call.method == "shutdown":
                    return  # a node told to shut down often dies before it answers: that is success
            else:
                return
            if attempt + 1 < self._tries:
                await asyncio.sleep(pause)
                pause *= 3
        self._troubled(incarnation, failure)
