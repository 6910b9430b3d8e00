"""Serve hosts in turn, so that a flood of requests from one host costs other hosts little.

The next slot goes to the host with the longest wait since its last turn. Hosts that the policy names as one network
are a *group*. A group shares one turn and at most half of the slots, so additional addresses in its network are
useless. With `own_slots`, each known group also has one slot of its own, so a host that begins does not wait for long
requests of guests that fill the slots.

A parameter tree needs ten times its size in memory while it is copied from the ROS master to a node. The *bulk* of a
request is a reservation for this memory. At most `AT_ONCE` requests may hold a bulk, one per host.
"""

import asyncio
import contextlib
import time
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable
from typing import Generic, ParamSpec, Self, TypeVar

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Holder, Pool, QuotaClass
from appliance.quotas.table import LARGE_WRITES
from appliance.rpc.processor_time import ProcessorTime
from roswire.xmlrpc import Value

P = ParamSpec("P")
T = TypeVar("T")

AT_ONCE = 2
_BOUNDS = Bounds(whole=AT_ONCE, host=1, unknown=1, kept=1)
_VALUE, _TEXT, _MEMBER, _ARRAY, _STRUCT = 45, 35, 40, 50, 40  # approximate bytes that XML-RPC adds to a value

Queue = deque[asyncio.Future[None]]


def itself(host: Hashable) -> Hashable:
    return host


class Turns(Generic[Holder]):
    """The turns of hosts. While a slot is free, only a host or group that has used up its quota waits.

    A host must pay for its audit records before it gets a slot: `pause(host)` returns the seconds to the next check.
    """

    def __init__(
        self,
        bounds: Bounds,
        quota_class: Callable[[Holder], QuotaClass],
        alike: Callable[[Holder], Hashable] = itself,
        pause: Callable[[str], float] = lambda _host: 0.0,
        *,
        own_slots: bool = False,
    ) -> None:
        self.slots: Pool[Holder] = Pool("requests being served", bounds, quota_class)
        self._quota_class = quota_class
        self._alike = alike
        self.pause = pause
        self._own_slots = own_slots
        self._own: dict[Hashable, Holder] = {}  # the host that has the own slot of its group
        self._together = max(bounds.host, bounds.whole // 2)
        self._taken: dict[Hashable, int] = {}  # slots by group, without its own
        self._taken_as: dict[Holder, Hashable] = {}
        self.waiting: OrderedDict[Hashable, OrderedDict[Holder, Queue]] = OrderedDict()

    async def enter(self, host: Holder) -> None:
        while seconds := self.pause(str(host)):
            await asyncio.sleep(seconds)
        kind = self._alike(host)
        if self._take(host, kind):
            return
        turn = asyncio.get_running_loop().create_future()
        self.waiting.setdefault(kind, OrderedDict()).setdefault(host, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.leave(host)
            else:
                self._give_up(kind, host, turn)
            raise

    def leave(self, host: Holder) -> None:
        self._give_back(host)
        while self.waiting and (following := self._next()) is not None:
            kind, host = following
            hosts = self.waiting.pop(kind)
            queue = hosts.pop(host)
            turn = queue.popleft()
            if queue:
                hosts[host] = queue  # the last in the queue: this host's next request waits for another round
            if hosts:
                self.waiting[kind] = hosts
            if turn.done():  # the waiting task was cancelled but has not removed its turn yet
                self._give_back(host)
            else:
                turn.set_result(None)

    def _next(self) -> tuple[Hashable, Holder] | None:
        for kind, hosts in self.waiting.items():
            if self._taken.get(kind, 0) < self._together or (self._own_slots and kind not in self._own):
                for host in hosts:
                    if self._take(host, kind):
                        return kind, host
        return None

    def _take(self, host: Holder, kind: Hashable) -> bool:
        kind = self._taken_as.get(host, kind)  # the group that the host's other slots are counted for
        if self._own_slots and kind not in self._own and self._quota_class(host) is not QuotaClass.UNKNOWN:
            self._own[kind] = host
        elif self._taken.get(kind, 0) >= self._together or self.slots.take(host):
            return False
        else:
            self._taken[kind] = self._taken.get(kind, 0) + 1
        self._taken_as[host] = kind
        return True

    def _give_back(self, host: Holder) -> None:
        kind = self._taken_as[host]
        if not self.slots.held(host):
            del self._own[kind]
        else:
            self.slots.give_back(host)
            self._taken[kind] -= 1
            if not self._taken[kind]:
                del self._taken[kind]
        if not self.slots.held(host) and self._own.get(kind) != host:
            del self._taken_as[host]

    def _give_up(self, kind: Hashable, host: Holder, turn: asyncio.Future[None]) -> None:
        hosts = self.waiting.get(kind, OrderedDict())
        queue = hosts.get(host)
        if queue is None or turn not in queue:
            return
        queue.remove(turn)
        if not queue:
            del hosts[host]
        if not hosts:
            self.waiting.pop(kind, None)


def bulk_turns(quota_class: Callable[[Address], QuotaClass]) -> Turns[Address]:
    return Turns(_BOUNDS, quota_class)


class Bulk:
    """The bulk of one request, reserved on demand and released when the request ends."""

    def __init__(self, turns: Turns[Address], host: Address, processor: ProcessorTime) -> None:
        self._turns = turns
        self._host = host
        self._processor = processor
        self.taken = False
        self.large = False  # whether the request itself is large

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.give_back()

    async def take(self) -> None:
        if not self.taken:
            await self._turns.enter(self._host)
            self.taken = True

    async def in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        used = 0.0

        def measure() -> T:
            nonlocal used
            since = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                used = time.thread_time() - since

        try:
            return await asyncio.to_thread(measure)
        finally:
            self._processor.charge_beside(self._host, used)

    def give_back(self) -> None:
        if self.taken:
            self.taken = False
            self._turns.leave(self._host)


class LargeWrites:
    """Lets each host write one large value at a time to the ROS master, or to another appliance.

    The threads of the ROS master would block each other while they read such values.
    """

    def __init__(
        self,
        enough: int,
        quota_class: Callable[[Address], QuotaClass],
        stored: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self._turns = Turns(LARGE_WRITES.bounds, quota_class)
        self._enough = enough
        self._stored = stored

    @contextlib.asynccontextmanager
    async def turn(self, host: Address, values: list[Value]) -> AsyncIterator[bool]:
        if weigh(values, self._enough) < self._enough:
            yield False
            return
        await self._turns.enter(host)
        try:
            yield True
            if self._stored is not None:
                await self._stored()
        finally:
            self._turns.leave(host)


def text_weight(text: str) -> int:
    if text.isascii() and not ("&" in text or "<" in text or ">" in text):
        return len(text)
    size = len(text.encode("utf-8", "surrogatepass"))
    return size + 4 * text.count("&") + 3 * (text.count("<") + text.count(">"))


def weigh(value: Value, enough: int) -> int:
    """Return the approximate bytes on the wire; counting stops at `enough`."""
    total = 0
    waiting: list[Value] = [value]
    while waiting and total < enough:
        value_ = waiting.pop()
        kind = type(value_)
        if kind is int:
            total += _VALUE
        elif kind is str:
            total += _TEXT + text_weight(value_)  # type: ignore[arg-type]  # it is one
        elif kind is bytes:
            total += _TEXT + len(value_)  # type: ignore[arg-type]  # it is one
        elif kind is list:
            total += _ARRAY
            waiting += value_  # type: ignore[arg-type]  # it is one
        elif isinstance(value_, dict):
            total += _STRUCT
            for name in value_:
                total += _MEMBER + text_weight(name)
                if total >= enough:
                    return total
            waiting += value_.values()
        else:
            total += _VALUE
    return total
