"""The relay's event loop: epoll and timers, single-threaded; long work runs in a thread `beside` it.

asyncio costs a callback, a transport and a future for each read; raw epoll halves the delay of a relayed message. The
pump waits (`transport/pump.pyx`), and serves an armed connection that is ready alone without Python.

Each descriptor has a *payer* for its processor time. The descriptors of a payer beyond the first `_DIRECT` are in a
second epoll, so they cannot hide those of other payers. Payers are served by deficit round robin in its continuous
form: the payer that has used the least processor time goes first. Idle time earns a credit of at most one quantum,
and a new payer starts behind the others. Before a *costly* payer, which used much more than a quantum in its last
turn, the other ready payers share one quantum.

- A handler is never called for a descriptor that was unwatched earlier in the same turn. `discard` closes a socket
  only at the end of the turn, so its number cannot refer to another socket in that turn.
- A turn calls the relay's own handlers first. Once payers have used `QUANTUM` in a turn, it serves at most one more
  costly payer. A payer, or all timers together, starts no handler after `QUANTUM`. A handler with much to do stops
  when the quantum is `over`, and passes the rest to `later`.
- A handler that raises an exception has a defect: the process ends, and the supervisor starts another.
"""

import heapq
import itertools
import os
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import NamedTuple, Protocol, TypeVar

from appliance.base import clock
from appliance.quotas.table import RELAY_TURN
from appliance.relay.transport.pump import LITTLE, Pump, PumpedConnection

READ = select.EPOLLIN
WRITE = select.EPOLLOUT
HANGUP = select.EPOLLRDHUP

SYSTEM = ""
"""The payer of the relay's own descriptors: they are always served first."""

UNKNOWN = "unknown hosts"
"""The payer for all hosts without a registration."""

ANYBODY = "hosts with a registration, by *"
"""The payer for all registered hosts that the policy names only by `*`."""

ACCEPTING = "new connections"
"""The payer for listening sockets."""

QUANTUM = RELAY_TURN.bounds.host * 1000
"""Nanoseconds of processor time that a payer gets in one turn."""

_DIRECT = 64  # a payer's descriptors in the loop's epoll; in its own epoll, each event costs 0.7 µs more
_PAYERS = 512  # number of payers beyond which idle ones are forgotten
_COSTLY = 3 * QUANTUM  # more than a payer uses if its handlers stop when the quantum is over

_EVENTS_PER_TURN = 64
_LONGEST_WAIT = 3600.0
_UNKNOWN = -1
_SWITCH_SECONDS = 0.0005  # the longest time that the loop waits for a thread beside it

T = TypeVar("T")

Handler = Callable[[int], None]


class LoopTimer:
    """A callback that is due at a time of the loop's clock; `cancel` may be called at any time."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        self.callback = None


class _Payer:
    """A payer: its ready events, the callbacks for its next turn, and the processor time that it has used."""

    __slots__ = (
        "costly",
        "crowd",
        "crowd_full",
        "crowd_ready",
        "crowd_since",
        "direct",
        "events",
        "later",
        "later_first",
        "name",
        "since",
        "spent",
        "watched",
    )

    def __init__(self, name: str, spent: int) -> None:
        self.name = name
        self.spent = spent
        self.watched = self.direct = 0
        self.crowd: select.epoll | None = None  # of its descriptors beyond `_DIRECT`
        self.crowd_ready = self.crowd_full = self.costly = False
        self.crowd_since = 0.0  # when the present events of the crowd were first found
        self.events: dict[int, int] = {}  # ready events by descriptor, in order
        self.since: dict[int, float] = {}  # when each of these was first found
        self.later: deque[Callable[[], None]] = deque()
        self.later_first = False


class _Watched(NamedTuple):
    handler: Handler
    payer: _Payer | None
    epoll: select.epoll


class WorkBeside(Protocol):
    """Work in a thread beside the loop."""

    def discard(self) -> None:
        """Wait for the end of the work, and drop its result."""


class _WorkThread:
    """Work in its own thread, and the descriptor with which it wakes the loop."""

    def __init__(self, loop: "EventLoop", work: Callable[[], T], done: Callable[[T], None]) -> None:
        sys.setswitchinterval(_SWITCH_SECONDS)
        self._loop = loop
        self._ended = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        results: list[T] = []

        def run() -> None:
            results.append(work())
            os.eventfd_write(self._ended, 1)

        def finish(_events: int) -> None:
            self.discard()
            done(results[0])

        loop.watch(self._ended, READ, finish)
        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def discard(self) -> None:
        self._thread.join()
        self._loop.unwatch(self._ended)
        os.close(self._ended)
        self._ended = -1


class EventLoop:
    """Watches descriptors and timers until `stop`. `processor_time` returns nanoseconds."""

    def __init__(self, processor_time: Callable[[], int] = time.thread_time_ns) -> None:
        self._epoll = select.epoll()
        self.pump = Pump(self._epoll.fileno())
        self._watched: dict[int, _Watched] = {}
        self._payers: dict[str, _Payer] = {}
        self._crowds: dict[int, _Payer] = {}  # by the descriptors of their epolls
        self._waiting: dict[str, _Payer] = {}
        self._floor = 0  # the least time used by any payer with work to do
        self._room = _EVENTS_PER_TURN
        self._timers: list[tuple[float, int, LoopTimer]] = []
        self._order = itertools.count()
        self._discarded: list[socket.socket] = []
        self._running = False
        self._processor_time = processor_time
        self._since = _UNKNOWN  # when the running handler began
        self._alone = False  # whether the running handler's descriptor is the only ready one
        self._longest = self._began = 0.0
        self.waited = 0.0
        """The seconds since an earlier turn found the running handler's descriptor ready; 0: the present turn did."""
        self.clock = clock.now

    def watch(
        self,
        descriptor: int,
        events: int,
        handler: Handler,
        payer: str = SYSTEM,
        pumped: PumpedConnection | None = None,
    ) -> None:
        """Call `handler(events)` while any of `events` is ready (level-triggered), and charge its time to the payer.

        While the descriptor is ready alone, steps of `pumped` precede the handler or replace it.
        """
        epoll, found = self._epoll, None
        if payer != SYSTEM:
            found = self._payer(payer)
            if found.direct >= _DIRECT:
                epoll = self._crowd(found)
        epoll.register(descriptor, events)
        self._watched[descriptor] = _Watched(handler, found, epoll)
        if pumped is not None:
            self.pump.put(descriptor, pumped)
        if found is not None:
            found.watched += 1
            found.direct += epoll is self._epoll

    def change(self, descriptor: int, events: int) -> None:
        """Change the events to wait for; errors and hang-ups are always reported."""
        watched = self._watched[descriptor]
        watched.epoll.modify(descriptor, events)
        if watched.payer is not None:
            watched.payer.events.pop(descriptor, None)
            watched.payer.since.pop(descriptor, None)

    def unwatch(self, descriptor: int) -> None:
        watched = self._watched.pop(descriptor, None)
        if watched is None:
            return
        watched.epoll.unregister(descriptor)
        self.pump.put(descriptor, None)
        payer = watched.payer
        if payer is not None:
            payer.events.pop(descriptor, None)
            payer.since.pop(descriptor, None)
            payer.watched -= 1
            payer.direct -= watched.epoll is self._epoll

    def discard(self, sock: socket.socket) -> None:
        if sock.fileno() >= 0:
            self.unwatch(sock.fileno())
            self._discarded.append(sock)

    def after(self, seconds: float, callback: Callable[[], None]) -> LoopTimer:
        timer = LoopTimer(callback)
        heapq.heappush(self._timers, (self.clock() + seconds, next(self._order), timer))
        return timer

    def later(self, callback: Callable[[], None], payer: str) -> None:
        found = self._payer(payer)
        found.later.append(callback)
        self._waiting[payer] = found

    def beside(self, work: Callable[[], T], done: Callable[[T], None]) -> "WorkBeside":
        """Do work in a thread while the loop continues; then call `done` with its result, in the loop's thread.

        `work` must not raise. `done` is not called before this method returns.
        """
        return _WorkThread(self, work, done)

    def time_used(self) -> int:
        """Return the running handler's processor time (ns), or the time since the first call if it is unknown."""
        now = self._processor_time()
        if self._since == _UNKNOWN:
            self._since = now
        return now - self._since

    def over(self) -> bool:
        return self.time_used() >= QUANTUM

    def charge(self, payer: str, used: int) -> None:
        """Charge a payer in addition to the payer of the running handler.

        If no other descriptor is ready, no other host loses time, so the use leaves no debt.
        """
        found = self._payer(payer)
        found.spent += used
        if self._alone:
            self._floor = max(self._floor, found.spent)

    def take_longest(self) -> float:
        """Return the longest time in seconds that a turn took since the last call: all else waited for it."""
        longest, self._longest = self._longest, 0.0
        return longest

    def stop(self) -> None:
        self._running = False

    def run(self) -> None:
        self._running = True
        while self._running:
            self.turn(_LONGEST_WAIT)

    def turn(self, longest: float) -> None:
        timers = self._timers
        if timers:
            left = timers[0][0] - self.clock()
            if left < longest:
                longest = left if left > 0 else 0
        waiting = self._waiting
        found = self.pump.wait(0 if waiting else longest, self._room, not waiting)
        began = self._began = self.clock()
        if len(found) == 1 and not waiting and found[0][0] in self._watched:
            self._serve_alone(*found[0], began)
        elif found or waiting:
            self._serve_many(found, began)
        now = self.clock()
        if timers and timers[0][0] <= now:
            self._call_due()
            now = self.clock()
        self._longest = max(self._longest, now - began)
        if self._discarded:
            self._close_discarded()

    def close(self) -> None:
        self._close_discarded()
        self._watched.clear()
        self._epoll.close()
        for payer in self._payers.values():
            if payer.crowd is not None:
                payer.crowd.close()

    def _payer(self, name: str) -> _Payer:
        payer = self._payers.get(name)
        if payer is None:
            if len(self._payers) >= _PAYERS:
                self._forget_idle()
            payer = self._payers[name] = _Payer(name, self._floor + QUANTUM)
        return payer

    def _crowd(self, payer: _Payer) -> select.epoll:
        if payer.crowd is None:
            payer.crowd = select.epoll()
            self._crowds[payer.crowd.fileno()] = payer
            self.pump.crowd(payer.crowd.fileno())
            self._epoll.register(payer.crowd.fileno(), READ)
        return payer.crowd

    def _forget_idle(self) -> None:
        for payer in list(self._payers.values()):
            if not payer.watched and not payer.later and payer.spent <= self._floor:
                del self._payers[payer.name]
                if payer.crowd is not None:
                    del self._crowds[payer.crowd.fileno()]
                    self.pump.put(payer.crowd.fileno(), None)
                    payer.crowd.close()

    def _serve_alone(self, number: int, events: int, now: float) -> None:
        self._since, began = _UNKNOWN, self.pump.began or now
        self.waited = 0.0
        handler, payer, _ = self._watched[number]
        self._alone = True
        handler(events)
        self._alone = False
        took = self.clock() - began
        if took > LITTLE and payer is not None:
            used = int(took * 1e9)
            payer.spent = max(payer.spent, self._floor - QUANTUM) + used
            payer.costly = used > _COSTLY
            self._floor = max(self._floor, payer.spent)

    def _serve_many(self, found: list[tuple[int, int]], now: float) -> None:
        ready = dict(self._waiting)
        for number, events in found:
            watched = self._watched.get(number)
            payer = self._crowds.get(number) if watched is None else watched.payer
            if payer is not None:
                if watched is None:
                    payer.crowd_since = payer.crowd_since if payer.crowd_full else now
                    payer.crowd_ready = True
                else:
                    payer.events[number] = events
                    payer.since.setdefault(number, now)
                ready[payer.name] = payer
            elif watched is not None:
                self._since = _UNKNOWN
                watched.handler(events)
        # If the report is full, others may be ready as well; the kernel's next report begins with these.
        if len(found) == self._room:
            self._room *= 2
        elif len(found) < self._room // 4:
            self._room = max(_EVENTS_PER_TURN, self._room // 2)
        if ready:
            self._serve_in_order(ready.values())

    def _serve_in_order(self, ready: Collection[_Payer]) -> None:
        self._since = began = self._processor_time()
        for payer in ready:
            payer.spent = max(payer.spent, self._floor - QUANTUM)
        in_order = sorted(ready, key=_spent)
        least = in_order[0].spent
        costly = next((payer for payer in in_order if payer.costly), None)
        for payer in in_order:
            if self._since - began >= QUANTUM or (costly is None and payer.spent - least > QUANTUM):
                break  # payers that have used more wait for those that may be ready again
            if not payer.costly:
                self._serve(payer)
        if costly is not None and costly.spent - least <= QUANTUM:
            self._serve(costly)
        self._floor = max(self._floor, min(map(_spent, in_order)))

    def _serve(self, payer: _Payer) -> None:
        """Call a payer's events and its postponed callbacks; each kind goes first in every second turn."""
        began = self._since
        if not payer.later:
            self._call_ready(payer, began)
        elif payer.later_first:
            self._call_later(payer, began)
            self._call_ready(payer, began)
        else:
            self._call_ready(payer, began)
            self._call_later(payer, began)
        payer.later_first = not payer.later_first
        if payer.later or payer.events:
            self._waiting[payer.name] = payer
        elif self._waiting:
            self._waiting.pop(payer.name, None)
        payer.costly = self._since - began > _COSTLY

    def _call_later(self, payer: _Payer, began: int) -> None:
        for _ in range(len(payer.later)):
            if self._since - began >= QUANTUM:
                return
            payer.later.popleft()()
            self._charge(payer)

    def _call_ready(self, payer: _Payer, began: int) -> None:
        ready = payer.events
        if payer.crowd_ready and payer.crowd is not None:
            payer.crowd_ready = False
            found = payer.crowd.poll(0, _EVENTS_PER_TURN)
            payer.crowd_full = len(found) == _EVENTS_PER_TURN
            ready.update(found)
            for number, _events in found:
                payer.since.setdefault(number, payer.crowd_since)
        while ready and self._since - began < QUANTUM:
            number = next(iter(ready))
            events = ready.pop(number)
            since = payer.since.pop(number, None)
            watched = self._watched.get(number)
            if watched is not None:
                self.waited = 0.0 if since is None or since == self._began else self.clock() - since
                watched.handler(events)
                self._charge(payer)

    def _charge(self, payer: _Payer) -> None:
        now = self._processor_time()
        payer.spent += now - self._since
        self._since = now

    def _call_due(self) -> None:
        now = self.clock()
        self._since = began = self._processor_time()
        while self._timers and self._timers[0][0] <= now and self._since - began < QUANTUM:
            callback = heapq.heappop(self._timers)[2].callback
            if callback is not None:
                callback()
                self._since = self._processor_time()

    def _close_discarded(self) -> None:
        for sock in self._discarded:
            sock.close()
        self._discarded.clear()


def _spent(payer: _Payer) -> int:
    return payer.spent
