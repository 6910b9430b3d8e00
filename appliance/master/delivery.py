"""Calls from the appliance to nodes that come from a master: each node has a queue of its own, in order.

A node that is slow or gone delays nobody else; ROSMaster's threads are answered before a node is called. Several
lists of publishers for one topic are all delivered, because roscpp must see a removal before the addition that
follows it. A call that fails is tried again a few times; then the node is looked at (`troubled`).
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.client import CallFailedError, XmlRpcClient
from appliance.master.registry import Incarnation
from appliance.ros.xmlrpc import Limits, Value

MASTER_NAME = "/master"


@dataclass(frozen=True, slots=True)
class NodeCall:
    """One call to a node: method and parameters after the caller's name."""

    method: str
    parameters: tuple[Value, ...]


class Delivery:
    """The queues. `timeout` is seconds for one call; a queue holds at most `bound` calls (the oldest go)."""

    def __init__(
        self,
        *,
        timeout: float,
        limits: Limits,
        troubled: Callable[[Incarnation, str], None],
        bound: int = 10_000,
        tries: int = 4,
    ) -> None:
        self._timeout = timeout
        self._limits = limits
        self._troubled = troubled
        self._bound = bound
        self._tries = tries
        self._queues: dict[str, deque[NodeCall]] = {}
        self._workers: dict[str, asyncio.Task[None]] = {}

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        """Queue a call for a node."""
        queue = self._queues.setdefault(incarnation.key, deque())
        if len(queue) >= self._bound:
            queue.popleft()
            self._troubled(incarnation, f"more than {self._bound} calls wait for it; the oldest was dropped")
        queue.append(call)
        if incarnation.key not in self._workers:
            worker = asyncio.get_running_loop().create_task(self._work(incarnation))
            self._workers[incarnation.key] = worker

    def drop(self, incarnation: Incarnation) -> None:
        """Forget what waits for a node."""
        self._queues.pop(incarnation.key, None)

    def close(self) -> None:
        """Stop delivering."""
        for worker in self._workers.values():
            worker.cancel()

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """A client that calls the node at its peer address."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=self._limits)

    async def _work(self, incarnation: Incarnation) -> None:
        try:
            while queue := self._queues.get(incarnation.key):
                await self._deliver(incarnation, queue.popleft())
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
