"""Limit the number of large bodies and answers in progress, by host, to save memory and the event loop.

A parameter tree takes ten times its size while it is read from the ROS master and written for a node. A request's
*bulk* is its need for that. `AT_ONCE` requests may have their bulk, one of each host, and hosts take turns.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
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


def bulk_turns(quota_class: Callable[[Address], QuotaClass]) -> Turns:
    """Return the turns that all requests share."""
    return Turns(_BOUNDS, quota_class)


class Bulk:
    """The bulk of one request: reserved when it is needed, and released at the end.

    Work outside the request's own steps (in a thread, in another task) is charged to the host here.
    """

    def __init__(self, turns: Turns, host: Address, processor: ProcessorTime) -> None:
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
        """Wait for room, unless the request already has it."""
        if not self.taken:
            await self._turns.enter(self._host)
            self.taken = True

    async def in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread, and charge its processor time to the host."""
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
        """Release the room."""
        if self.taken:
            self.taken = False
            self._turns.leave(self._host)


class LargeWrites:
    """The limit of large values on their way to the ROS master: one of each host.

    The ROS master is one Python process: many threads that read large values would block all others. A call with a
    turn waits only for the ROS master.
    """

    def __init__(self, enough: int, quota_class: Callable[[Address], QuotaClass]) -> None:
        self._turns = Turns(LARGE_WRITES.bounds, quota_class)
        self._enough = enough

    @contextlib.asynccontextmanager
    async def turn(self, host: Address, values: list[Value]) -> AsyncIterator[bool]:
        """Surround a write of these values to the ROS master; yield whether they are large and so took a turn."""
        if weigh(values, self._enough) < self._enough:
            yield False
            return
        await self._turns.enter(host)
        try:
            yield True
        finally:
            self._turns.leave(host)


def text_weight(text: str) -> int:
    """Return the approximate bytes of a string on the wire, with `&`, `<` and `>` escaped."""
    if text.isascii() and not ("&" in text or "<" in text or ">" in text):
        return len(text)
    size = len(text.encode("utf-8", "surrogatepass"))
    return size + 4 * text.count("&") + 3 * (text.count("<") + text.count(">"))


def weigh(value: Value, enough: int) -> int:
    """Return the approximate bytes of a value on the wire; stop counting at `enough`."""
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
