"""Share the processor time of one event loop among hosts: start-time fair queueing.

1. In one turn of the loop, work runs for `TURN_SECONDS`, and the last piece may finish later.
2. The waiting class of hosts with the least use runs next, and in this class the host with the least use. All unknown
   hosts are one class.
3. A class that comes back waits for one piece of work, not for one piece of every other class.
4. A class cannot save up time. After a break, it starts with the use of the waiting classes.
5. A class keeps its debt while other classes wait. All use is forgotten when a turn ends and no work waits, because a
   class that works alone takes no time from others.
"""

import asyncio
import heapq
import itertools
import time
from asyncio import _enter_task, _leave_task, _register_task  # documented, for other implementations of tasks
from collections import deque
from collections.abc import Callable, Coroutine, Hashable
from operator import itemgetter
from typing import Any, Generic, TypeVar

from appliance.quotas.table import RVMASTER_TIME

TURN_SECONDS = RVMASTER_TIME.bounds.whole / 1e6
_MAX_KEPT = 1024  # keys with a stored use; beyond this, only the largest debts are kept

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")
T = TypeVar("T")
_Awaited = asyncio.Future[object] | None
"""The future that a step of a coroutine waits for; None: for the next turn only."""
Work = Callable[[], None]


class Line(Generic[Key, Item]):
    """A queue in which the key with the least use, in seconds, is next.

    A key that comes back starts with `start`, the use of the key that was served last.
    """

    def __init__(self) -> None:
        self.start = 0.0
        self._used: dict[Key, float] = {}
        self.queues: dict[Key, deque[Item]] = {}  # no queue is empty
        self._order: list[tuple[float, int, Key]] = []  # a heap; the stored use of a key may be too low
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return sum(map(len, self.queues.values()))

    def time_used(self, key: Key) -> float:
        used, start = self._used.get(key, self.start), self.start
        return used if used > start else start

    def charge(self, key: Key, seconds: float) -> None:
        kept, start = self._used, self.start
        used = kept.get(key, start)
        kept[key] = (used if used > start else start) + seconds
        if len(kept) > _MAX_KEPT:
            # Keep only half of them, so that the next removal does not follow soon.
            largest = heapq.nlargest(_MAX_KEPT // 2, kept.items(), key=itemgetter(1))
            self._used = {one: used for one, used in largest if used > start}

    def forget(self) -> None:
        self._used.clear()

    def put(self, key: Key, item: Item) -> None:
        queue = self.queues.get(key)
        if queue is None:
            self.queues[key] = deque([item])
            heapq.heappush(self._order, (self.time_used(key), next(self._numbers), key))
        else:
            queue.append(item)

    def pop(self) -> tuple[Key, Item]:
        order = self._order
        while True:
            stored, _, key = order[0]
            used = self.time_used(key)
            if stored >= used:
                break
            heapq.heapreplace(order, (used, next(self._numbers), key))
        self.start = used
        queue = self.queues[key]
        item = queue.popleft()
        if queue:
            heapq.heapreplace(order, (used, next(self._numbers), key))
        else:
            heapq.heappop(order)
            del self.queues[key]
        return key, item


class ProcessorTime:
    """Shares the time of the loop; `kind(host)` returns the class of a host, `clock` processor seconds."""

    def __init__(
        self,
        kind: Callable[[Any], Hashable],
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._kind = kind
        self._clock = clock
        self._classes: Line[Hashable, None] = Line()  # one item for each piece of work
        self._hosts: dict[Hashable, Line[Hashable, Work]] = {}  # the hosts of each waiting class
        self._spent = 0.0  # seconds in this turn of the loop
        self._since: float | None = None  # the start of the running piece
        self._turn_ends = False  # whether the end of this turn is scheduled

    @property
    def waiting(self) -> int:
        return len(self._classes)

    @property
    def running(self) -> bool:
        return self._since is not None

    def run(self, host: Hashable, work: Work) -> bool:
        """Run work of a host now, or queue it for the host's turn and return False.

        Exceptions of the work are reported to the event loop.
        """
        running = 0.0 if self._since is None else self._clock() - self._since
        if not self._classes.queues and self._spent + running < TURN_SECONDS:
            self._do(host, work)
            return True
        self._queue(host, work)
        return False

    def charge(self, host: Hashable, seconds: float) -> None:
        self._spent += seconds
        self.charge_beside(host, seconds)
        self._end_turn_later()

    def charge_beside(self, host: Hashable, seconds: float) -> None:
        kind = self._kind(host)
        self._classes.charge(kind, seconds)
        if (hosts := self._hosts.get(kind)) is not None:
            hosts.charge(host, seconds)

    def begin(self) -> bool:
        if self._since is not None:
            return False
        self._since = self._clock()
        return True

    def end(self, host: Hashable) -> None:
        assert self._since is not None  # noqa: S101  by `begin`
        seconds, self._since = self._clock() - self._since, None
        self.charge(host, seconds)

    def _do(self, host: Hashable, work: Work) -> None:
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

    def _queue(self, host: Hashable, work: Work) -> None:
        kind = self._kind(host)
        self._classes.put(kind, None)
        hosts = self._hosts.get(kind)
        if hosts is None:
            hosts = self._hosts[kind] = Line()
        hosts.put(host, work)
        self._end_turn_later()

    def _end_turn_later(self) -> None:
        if not self._turn_ends:
            self._turn_ends = True
            asyncio.get_running_loop().call_soon(self._new_turn)

    def _new_turn(self) -> None:
        self._turn_ends = False
        self._spent = 0.0
        classes = self._classes
        while classes.queues and self._spent < TURN_SECONDS:
            kind, _ = classes.pop()
            hosts = self._hosts[kind]
            self._do(*hosts.pop())
            if not hosts.queues:
                del self._hosts[kind]
        if classes.queues:
            self._end_turn_later()
        else:
            classes.forget()


class HostTask(asyncio.Future[T]):
    """A coroutine that runs in the turns of a host, which is charged for each step.

    The first step runs at once, because most requests wait for nothing; asyncio would start a task in a later turn.
    """

    def __init__(self, time: ProcessorTime, host: Hashable, work: Coroutine[_Awaited, None, T]) -> None:
        super().__init__()
        self._time = time
        self._host = host
        self._work = work
        self._awaited: _Awaited = None
        self._cancels = 0  # without those that `uncancel` has undone
        self._cancel_soon = False  # whether the next step raises `CancelledError` in the coroutine
        if time.running:
            self._step()
        else:
            self._go_on()
        if not self.done():
            _register_task(self)  # type: ignore[arg-type]  # it has the methods of a task

    def cancel(self, msg: object | None = None) -> bool:
        if self.done():
            return False
        self._cancels += 1
        self._cancel_soon = self._awaited is None or not self._awaited.cancel(msg)
        return True

    def cancelling(self) -> int:
        return self._cancels

    def uncancel(self) -> int:
        self._cancels = max(0, self._cancels - 1)
        return self._cancels

    def _go_on(self, _awaited: _Awaited = None) -> None:
        self._awaited = None
        self._time.run(self._host, self._step)

    def _step(self) -> None:
        loop = self.get_loop()
        outer = asyncio.current_task(loop)  # if this task is made in a step of another one
        if outer is not None:
            _leave_task(loop, outer)
        _enter_task(loop, self)  # type: ignore[arg-type]  # as above
        try:
            self._wait_for(self._resume())
        except StopIteration as done:
            self.set_result(done.value)
        except asyncio.CancelledError:
            super().cancel()
        except Exception as error:  # noqa: BLE001 - passed on to the owner of the task
            self.set_exception(error)
        finally:
            _leave_task(loop, self)  # type: ignore[arg-type]  # as above
            if outer is not None:
                _enter_task(loop, outer)

    def _resume(self) -> _Awaited:
        if self._cancel_soon:
            self._cancel_soon = False
            return self._work.throw(asyncio.CancelledError())
        return self._work.send(None)

    def _wait_for(self, awaited: _Awaited) -> None:
        if awaited is None:  # `asyncio.sleep(0)`
            self.get_loop().call_soon(self._go_on)
            return
        awaited._asyncio_future_blocking = False  # as asyncio requires of tasks
        awaited.add_done_callback(self._go_on)
        self._awaited = awaited
        if self._cancel_soon:
            self._cancel_soon = not awaited.cancel()
