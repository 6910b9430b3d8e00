"""Large bodies and answers: few at a time, host by host, so that memory and the event loop are there for others.

A tree of parameters takes ten times its size while it is read from ROSMaster and written for a node. What one request
needs for that is its *bulk*: there is room for the bulk of `AT_ONCE` requests, one of each host, and hosts take turns.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from typing import ParamSpec, Self, TypeVar

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Standing
from appliance.quotas.table import LARGE_WRITES
from appliance.rpc.fair_queue import Turns
from appliance.rpc.processor_time import ProcessorTime
from roswire.xmlrpc import Value

P = ParamSpec("P")
T = TypeVar("T")

AT_ONCE = 2
_BOUNDS = Bounds(whole=AT_ONCE, host=1, strangers=1, kept=1)
_VALUE, _TEXT, _MEMBER, _ARRAY, _STRUCT = 45, 35, 40, 50, 40  # about what XML-RPC writes around a value


def bulk_turns(standing: Callable[[Address], Standing]) -> Turns:
    """The turns that all requests share."""
    return Turns(_BOUNDS, standing)


class Bulk:
    """The bulk of one request of a host: room for it is taken when it is needed, and given back at the end.

    What is done beside the request's own steps (in a thread, in another task) is charged to the host here.
    """

    def __init__(self, turns: Turns, host: Address, processor: ProcessorTime) -> None:
        self._turns = turns
        self._host = host
        self._processor = processor
        self.taken = False
        self.large = False  # whether the request itself is

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.give_back()

    async def take(self) -> None:
        """Wait for room, unless it is taken already."""
        if not self.taken:
            await self._turns.enter(self._host)
            self.taken = True

    async def in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread, whose processor time is the host's."""
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
        """Make room for others."""
        if self.taken:
            self.taken = False
            self._turns.leave(self._host)


class LargeWrites:
    """Large values on their way to ROSMaster: few at a time, one of each host.

    ROSMaster is one Python process: what many of its threads read at once, all others wait for. Whoever has a turn
    waits for nothing but ROSMaster.
    """

    def __init__(self, enough: int, standing: Callable[[Address], Standing]) -> None:
        self._turns = Turns(LARGE_WRITES.bounds, standing)
        self._enough = enough

    @contextlib.asynccontextmanager
    async def turn(self, host: Address, values: list[Value]) -> AsyncIterator[bool]:
        """Carry out what brings these values to ROSMaster; small ones wait for nobody, large ones may (True)."""
        if weigh(values, self._enough) < self._enough:
            yield False
            return
        await self._turns.enter(host)
        try:
            yield True
        finally:
            self._turns.leave(host)


def text_weight(text: str) -> int:
    """About how many bytes a text takes on the wire, where `&`, `<` and `>` are written out."""
    if text.isascii() and not ("&" in text or "<" in text or ">" in text):
        return len(text)
    size = len(text.encode("utf-8", "surrogatepass"))
    return size + 4 * text.count("&") + 3 * (text.count("<") + text.count(">"))


def weigh(value: Value, enough: int) -> int:
    """About how many bytes a value takes on the wire; counting ends when it is `enough`."""
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
