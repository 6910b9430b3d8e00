"""Limit the number of large bodies and answers in progress by host, to save memory and time of the event loop.

A parameter tree needs ten times its size in memory while it is copied from the ROS master to a node. The *bulk* of a
request is a reservation for this memory. At most `AT_ONCE` requests may hold a bulk, one per host; hosts take turns.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import ParamSpec, Self, TypeVar

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import LARGE_WRITES
from appliance.rpc.fair_queue import Turns
from appliance.rpc.processor_time import ProcessorTime
from roswire.xmlrpc import Value

P = ParamSpec("P")
T = TypeVar("T")

AT_ONCE = 2
_BOUNDS = Bounds(whole=AT_ONCE, host=1, unknown=1, kept=1)
_VALUE, _TEXT, _MEMBER, _ARRAY, _STRUCT = 45, 35, 40, 50, 40  # approximate bytes that XML-RPC adds to a value


def bulk_turns(quota_class: Callable[[Address], QuotaClass]) -> Turns[Address]:
    return Turns(_BOUNDS, quota_class)


class Bulk:
    """Reserved on demand, and released when the request ends.

    `in_thread` charges the host for work in a thread, which is not part of the request's own steps.
    """

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
        """Do nothing if the request already has it."""
        if not self.taken:
            await self._turns.enter(self._host)
            self.taken = True

    async def in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Charge the processor time to the host."""
        used = 0.0

        def measured() -> T:
            nonlocal used
            since = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                used = time.thread_time() - since

        try:
            return await asyncio.to_thread(measured)
        finally:
            self._processor.charge_beside(self._host, used)

    def give_back(self) -> None:
        if self.taken:
            self.taken = False
            self._turns.leave(self._host)


class LargeWrites:
    """Large values to the ROS master and to another appliance go one at a time for each host.

    The ROS master is one Python process, whose threads would block each other while they read large values. The
    changes of all hosts reach the other appliance in one order. A call that has its turn waits only for these two;
    `stored` waits for the other appliance.
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
        """Yield whether the values are large."""
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
    """Approximate bytes on the wire, with `&`, `<` and `>` escaped."""
    if text.isascii() and not ("&" in text or "<" in text or ">" in text):
        return len(text)
    size = len(text.encode("utf-8", "surrogatepass"))
    return size + 4 * text.count("&") + 3 * (text.count("<") + text.count(">"))


def weigh(value: Value, enough: int) -> int:
    """Approximate bytes on the wire; stop counting at `enough`."""
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
