"""Processor time of one event loop, shared by hosts: start-time fair queueing.

Work for a host (accept a connection, read a piece of a request, one step of a handler) is measured and charged.
Invariants:

1. In one turn of the loop, work runs for `TURN_SECONDS` and at most one piece longer; the rest waits for later turns.
   The pieces themselves are short: whoever has a long task divides it, with `await asyncio.sleep(0)` between.
2. Of the classes of hosts that wait, the one that has used least runs next, and in a class the host that has used
   least. All unknown hosts are one class. This is deficit round robin without the round: a class that comes back
   waits for one piece, not for a piece of every other class.
3. Nobody saves up: a class that waited for nothing begins where the others are. What it used too much it still owes.
4. While nobody waits and the turn has time left, work runs at once.
"""

import asyncio
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Coroutine, Generator, Hashable, Iterable
from typing import Any, Generic, TypeVar

from appliance.policy.model import Address
from appliance.shares.table import RVMASTER_TIME

TURN_SECONDS = RVMASTER_TIME.bounds.whole / 1e6
_MOST_KEPT = 1024  # entries of what was used, before those that owe nothing are removed

Key = TypeVar("Key", bound=Hashable)
T = TypeVar("T")
Work = Callable[[], None]
Steps = Generator[Any, Any, T]


class Usage(Generic[Key]):
    """What each key has used, in seconds, and who is next; `start` is where a key without an entry begins."""

    def __init__(self) -> None:
        self.start = 0.0
        self._used: dict[Key, float] = {}

    def charge(self, key: Key, seconds: float) -> None:
        """Add to what a key has used."""
        self._used[key] = self.of(key) + seconds
        if len(self._used) > _MOST_KEPT:
            self._used = {one: used for one, used in self._used.items() if used > self.start}

    def of(self, key: Key) -> float:
        """What a key has used; at least what all that wait have used."""
        return max(self._used.get(key, self.start), self.start)

    def next(self, waiting: Iterable[Key]) -> Key:
        """The one that has used least of those that wait, the longest waiting of equal ones."""
        key = min(waiting, key=self.of)
        self.start = self.of(key)
        return key


class _Class:
    """Hosts that share as one: their work that waits, by host, and what each has used."""

    __slots__ = ("usage", "waiting")

    def __init__(self) -> None:
        self.waiting: OrderedDict[Address, deque[Work]] = OrderedDict()
        self.usage: Usage[Address] = Usage()


class ProcessorTime:
    """Runs work for hosts. `kind(host)` is the same for hosts that share as one; `clock` counts processor seconds."""

    def __init__(
        self,
        kind: Callable[[Address], Hashable],
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._kind = kind
        self._clock = clock
        self._usage: Usage[Hashable] = Usage()
        self._waiting: OrderedDict[Hashable, _Class] = OrderedDict()
        self._spent = 0.0  # in this turn of the loop
        self._since: float | None = None  # when the piece began that runs now
        self._turn_ends = False  # whether the end of this turn is scheduled
        self._granted = False  # a step that may run now and has not begun

    @property
    def waiting(self) -> int:
        """The pieces of work that wait."""
        return sum(len(queue) for each in self._waiting.values() for queue in each.waiting.values())

    @property
    def free(self) -> bool:
        """Whether work may run at once: nobody waits, and this turn has time left."""
        return not self._waiting and not self._granted and self._left > 0

    @property
    def _left(self) -> float:
        running = 0.0 if self._since is None else self._clock() - self._since
        return TURN_SECONDS - self._spent - running

    def run(self, host: Address, work: Work) -> bool:
        """Run short work for a host, now (True) or when it is its turn; what it raises is reported to the loop."""
        if self.free:
            self._do(host, work)
            return True
        self._queue(host, work)
        return False

    def steps(self, host: Address, work: Coroutine[Any, Any, T]) -> "_InSteps[T]":
        """Carry out a coroutine: each of its steps, from one `await` to the next, runs when it is the host's turn."""
        return _InSteps(self, host, work)

    async def spend(self, host: Address, work: Coroutine[Any, Any, T]) -> T:
        """As `steps`, for a task."""
        return await _InSteps(self, host, work)

    def charge(self, host: Address, seconds: float) -> None:
        """Count time that was used for a host, in this turn."""
        kind = self._kind(host)
        self._spent += seconds
        self._usage.charge(kind, seconds)
        if (line := self._waiting.get(kind)) is not None:
            line.usage.charge(host, seconds)
        self._end_turn_later()

    def begin(self) -> bool:
        """A piece begins; False inside another one, which is charged with it."""
        if self._since is not None:
            return False
        self._since = self._clock()
        return True

    def end(self, host: Address) -> None:
        """The piece that began has ended; it was for this host."""
        assert self._since is not None  # noqa: S101  by `begin`
        seconds, self._since = self._clock() - self._since, None
        self.charge(host, seconds)

    def turn_of(self, host: Address) -> "asyncio.Future[None]":
        """A future that is done when it is the host's turn; whoever has it calls `taken`, also if it is cancelled."""
        turn = asyncio.get_running_loop().create_future()

        def grant() -> None:
            if not turn.done():
                self._granted = True
                turn.set_result(None)

        self._queue(host, grant)
        return turn

    def taken(self, turn: "asyncio.Future[None]") -> None:
        """The step that this turn was for has run, or will not."""
        if turn.done() and not turn.cancelled():
            self._granted = False
            self._go_on()

    def _do(self, host: Address, work: Work) -> None:
        outermost = self.begin()
        try:
            work()
        except Exception as error:  # noqa: BLE001 - a defect in the work of one host stops no other
            asyncio.get_running_loop().call_exception_handler(
                {"message": f"work for {host} failed", "exception": error}
            )
        finally:
            if outermost:
                self.end(host)

    def _queue(self, host: Address, work: Work) -> None:
        line = self._waiting.setdefault(self._kind(host), _Class())
        line.waiting.setdefault(host, deque()).append(work)
        self._end_turn_later()

    def _end_turn_later(self) -> None:
        if not self._turn_ends:
            self._turn_ends = True
            asyncio.get_running_loop().call_soon(self._new_turn)

    def _new_turn(self) -> None:
        self._turn_ends = False
        self._spent = 0.0
        self._go_on()
        if self._waiting:
            self._end_turn_later()

    def _go_on(self) -> None:
        """Run what waits, as long as this turn has time left; of granted steps one at a time."""
        while self._waiting and not self._granted and self._left > 0:
            kind = self._usage.next(self._waiting)
            line = self._waiting[kind]
            host = line.usage.next(line.waiting)
            queue = line.waiting[host]
            work = queue.popleft()
            if not queue:
                del line.waiting[host]
            self._do(host, work)
            if not line.waiting:
                del self._waiting[kind]


class _InSteps(Generic[T]):
    """Awaits a coroutine step by step (`ProcessorTime.steps`)."""

    __slots__ = ("_host", "_time", "_work")

    def __init__(self, time: ProcessorTime, host: Address, work: Coroutine[Any, Any, T]) -> None:
        self._time = time
        self._host = host
        self._work = work

    def __await__(self) -> Steps[T]:
        value, error = None, None
        try:
            while True:
                turn = None
                if error is None and not self._time.free:
                    turn = self._time.turn_of(self._host)
                    try:
                        yield from turn
                    except BaseException as raised:  # noqa: BLE001 - it is the work's to handle
                        error = raised
                try:
                    awaited = self._step(value, error)
                except StopIteration as done:
                    return done.value  # type: ignore[no-any-return]  # the work's result
                finally:
                    if turn is not None:
                        self._time.taken(turn)
                value, error = None, None
                try:
                    value = yield awaited
                except BaseException as raised:  # noqa: BLE001 - same
                    error = raised
        finally:
            self._work.close()

    def _step(self, value: Any, error: BaseException | None) -> Any:
        outermost = self._time.begin()
        try:
            return self._work.send(value) if error is None else self._work.throw(error)
        finally:
            if outermost:
                self._time.end(self._host)
