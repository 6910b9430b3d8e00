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
import heapq
import time
from collections import deque
from collections.abc import Callable, Coroutine, Generator, Hashable
from typing import Any, Generic, TypeVar

from appliance.policy.model import Address
from appliance.quotas.table import RVMASTER_TIME

TURN_SECONDS = RVMASTER_TIME.bounds.whole / 1e6
_MOST_KEPT = 1024  # entries of what was used, before those that owe nothing are removed

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")
T = TypeVar("T")
Work = Callable[[], None]
Steps = Generator[Any, Any, T]


class Line(Generic[Key, Item]):
    """Items that wait, by key: the next is of the key that has used least. All in seconds.

    `start` is what the key that was next last had used, and where a key begins that comes back.
    """

    def __init__(self) -> None:
        self.start = 0.0
        self._used: dict[Key, float] = {}
        self._items: dict[Key, deque[Item]] = {}
        self._order: list[tuple[float, int, Key]] = []  # a heap; what a key has used may be more by now
        self._count = 0

    def __len__(self) -> int:
        return sum(map(len, self._items.values()))

    def __bool__(self) -> bool:
        return bool(self._items)

    def used(self, key: Key) -> float:
        """What a key has used; at least what those have used that wait."""
        return max(self._used.get(key, self.start), self.start)

    def charge(self, key: Key, seconds: float) -> None:
        """Add to what a key has used."""
        self._used[key] = self.used(key) + seconds
        if len(self._used) > _MOST_KEPT:
            self._used = {one: used for one, used in self._used.items() if used > self.start}

    def put(self, key: Key, item: Item) -> None:
        """The item waits, the last one of its key."""
        queue = self._items.get(key)
        if queue is None:
            self._items[key] = deque([item])
            heapq.heappush(self._order, self._entry(key))
        else:
            queue.append(item)

    def pop(self) -> tuple[Key, Item]:
        """The next item, and its key; of keys that have used the same, that which waits longest."""
        while self._order[0][0] < self.used(self._order[0][2]):
            heapq.heapreplace(self._order, self._entry(self._order[0][2]))
        key = self._order[0][2]
        self.start = self.used(key)
        queue = self._items[key]
        item = queue.popleft()
        if queue:
            heapq.heapreplace(self._order, self._entry(key))
        else:
            heapq.heappop(self._order)
            del self._items[key]
        return key, item

    def _entry(self, key: Key) -> tuple[float, int, Key]:
        self._count += 1
        return self.used(key), self._count, key


class ProcessorTime:
    """Runs work for hosts. `kind(host)` is the same for hosts that share as one; `clock` counts processor seconds."""

    def __init__(
        self,
        kind: Callable[[Address], Hashable],
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._kind = kind
        self._clock = clock
        self._classes: Line[Hashable, None] = Line()  # an item for each piece of work
        self._hosts: dict[Hashable, Line[Address, Work]] = {}  # of classes that wait
        self._spent = 0.0  # in this turn of the loop
        self._since: float | None = None  # when the piece began that runs now
        self._turn_ends = False  # whether the end of this turn is scheduled
        self._granted = False  # a step that may run now and has not begun

    @property
    def waiting(self) -> int:
        """The pieces of work that wait."""
        return len(self._classes)

    @property
    def free(self) -> bool:
        """Whether work may run at once: nobody waits, and this turn has time left."""
        return not self._classes and not self._granted and self._left > 0

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
        self._spent += seconds
        self.charge_beside(host, seconds)
        self._end_turn_later()

    def charge_beside(self, host: Address, seconds: float) -> None:
        """Count time that was used for a host, in another thread."""
        kind = self._kind(host)
        self._classes.charge(kind, seconds)
        if (hosts := self._hosts.get(kind)) is not None:
            hosts.charge(host, seconds)

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
        kind = self._kind(host)
        self._classes.put(kind, None)
        self._hosts.setdefault(kind, Line()).put(host, work)
        self._end_turn_later()

    def _end_turn_later(self) -> None:
        if not self._turn_ends:
            self._turn_ends = True
            asyncio.get_running_loop().call_soon(self._new_turn)

    def _new_turn(self) -> None:
        self._turn_ends = False
        self._spent = 0.0
        self._go_on()
        if self._classes:
            self._end_turn_later()

    def _go_on(self) -> None:
        """Run what waits, as long as this turn has time left; of granted steps one at a time."""
        while self._classes and not self._granted and self._left > 0:
            kind, _ = self._classes.pop()
            hosts = self._hosts[kind]
            self._do(*hosts.pop())
            if not hosts:
                del self._hosts[kind]


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
