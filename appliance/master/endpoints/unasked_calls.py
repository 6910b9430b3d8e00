"""Call nodes that did not ask for it: which parameters a node cached under another master is unknown.

1. No other call to a node waits for these: they have connections and turns of their own, by host.
2. A node gets only the newest call of a key, and a pause between two rounds of calls.
3. A node that answers that it did not subscribe to a key gets none of that key any more (rospy). One that does not
   answer several times gets none at all: its client library has no such call. roscpp answers each.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import structlog

from appliance.policy.model import Address
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value

_APART_SECONDS = 0.2  # between two rounds of calls to a node
_AT_ONCE_OF_HOST = 8
_MOST_UNANSWERED = 5  # in a row; a node that hangs for some seconds still gets the newest value
_MOST_KEYS = 2_000  # of a node, that wait or are known not to be subscribed

_log = structlog.get_logger()


class Named(Protocol):
    """A node; `key` tells apart its lives."""

    @property
    def key(self) -> str: ...

    @property
    def name(self) -> str: ...

    @property
    def host(self) -> Address: ...


N = TypeVar("N", bound=Named)
C = TypeVar("C")


@dataclass(slots=True)
class _Node(Generic[C]):
    waiting: dict[str, C] = field(default_factory=dict)  # by key, oldest first
    foreign: set[str] = field(default_factory=set)
    unanswered: int = 0
    worker: asyncio.Task[None] | None = None


class UnaskedCalls(Generic[N, C]):
    """Carries out calls with `call(node, call)`, which raises `CallFailedError`."""

    def __init__(self, call: Callable[[N, C], Awaitable[Value]]) -> None:
        self._call = call
        self._nodes: dict[str, _Node[C]] = {}
        self._turns: dict[Address, asyncio.Semaphore] = {}

    def push(self, node: N, key: str, call: C) -> None:
        known = self._nodes.setdefault(node.key, _Node())
        if key in known.foreign or known.unanswered >= _MOST_UNANSWERED:
            return
        if key not in known.waiting and len(known.waiting) >= _MOST_KEYS:
            del known.waiting[next(iter(known.waiting))]
        known.waiting[key] = call
        if known.worker is None:
            known.worker = asyncio.get_running_loop().create_task(self._work(node, known))

    def drop(self, node: N) -> None:
        known = self._nodes.pop(node.key, None)
        if known is not None and known.worker is not None:
            known.worker.cancel()

    def clear(self) -> None:
        """End the calls under way, and forget those that wait and all that is known of the nodes."""
        for known in self._nodes.values():
            if known.worker is not None:
                known.worker.cancel()
        self._nodes.clear()
        self._turns.clear()

    async def _work(self, node: N, known: _Node[C]) -> None:
        while known.waiting:
            for key in [*known.waiting]:
                await self._tell(node, known, key)
                if known.unanswered >= _MOST_UNANSWERED:
                    _log.info("a node does not take parameters that it did not ask for", node=node.name)
                    known.waiting.clear()
                    break
            await asyncio.sleep(_APART_SECONDS)
        known.worker = None

    async def _tell(self, node: N, known: _Node[C], key: str) -> None:
        async with self._turns.setdefault(node.host, asyncio.Semaphore(_AT_ONCE_OF_HOST)):
            call = known.waiting.pop(key, None)
            if call is None:
                return
            try:
                answer = await self._call(node, call)
            except CallFailedError:
                known.unanswered += 1
                known.waiting.setdefault(key, call)
                return
        known.unanswered = 0
        if isinstance(answer, list) and answer[:1] == [-1]:
            if len(known.foreign) >= _MOST_KEYS:
                known.foreign.clear()
            known.foreign.add(key)
        elif known.foreign:  # it has what is below this key
            known.foreign -= {one for one in known.foreign if one.startswith(f"{key.rstrip('/')}/")}
