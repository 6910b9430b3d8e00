"""The relay's event loop: epoll and timers, single-threaded, nothing else.

Why not asyncio: one frame per read costs a callback, a transport and a future's worth of Python; raw epoll
with one bound method per descriptor halves the delay a relayed message sees.

Invariants:
- A handler is never called for a descriptor that was unwatched earlier in the same turn, and a descriptor
  closed through `discard` is closed only at the end of the turn, so its number cannot mean another socket
  within it.
- A handler that raises is a defect; the exception ends the process and the supervisor starts another.
"""

import heapq
import itertools
import select
import socket
import time
from collections.abc import Callable

READ = select.EPOLLIN
WRITE = select.EPOLLOUT
HANGUP = select.EPOLLRDHUP

# Python takes memory for so many each time: for more of them not from where that is quick
_EVENTS_PER_TURN = 64
_LONGEST_WAIT = 3600.0

Handler = Callable[[int], None]


class Timer:
    """A callback that is due at a time of the loop's clock; `cancel` may be called at any time."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        """The callback will not be called."""
        self.callback = None


class Loop:
    """Watches descriptors and timers until `stop`."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._handlers: dict[int, Handler] = {}
        self._timers: list[tuple[float, int, Timer]] = []
        self._order = itertools.count()
        self._discarded: list[socket.socket] = []
        self._running = False
        self.clock = time.monotonic

    def watch(self, descriptor: int, events: int, handler: Handler) -> None:
        """Call `handler(events)` whenever one of `events` is there (level-triggered)."""
        self._epoll.register(descriptor, events)
        self._handlers[descriptor] = handler

    def change(self, descriptor: int, events: int) -> None:
        """Wait for other events on a watched descriptor; errors and hang-ups are always reported."""
        self._epoll.modify(descriptor, events)

    def unwatch(self, descriptor: int) -> None:
        """No handler is called for the descriptor any more; unknown descriptors are fine."""
        if self._handlers.pop(descriptor, None) is not None:
            self._epoll.unregister(descriptor)

    def discard(self, sock: socket.socket) -> None:
        """Unwatch a socket now and close it at the end of this turn."""
        if sock.fileno() >= 0:
            self.unwatch(sock.fileno())
            self._discarded.append(sock)

    def after(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call `callback` once, `seconds` from now."""
        timer = Timer(callback)
        heapq.heappush(self._timers, (self.clock() + seconds, next(self._order), timer))
        return timer

    def stop(self) -> None:
        """End `run` after this turn."""
        self._running = False

    def run(self) -> None:
        """Serve until `stop`."""
        self._running = True
        while self._running:
            self.turn(_LONGEST_WAIT)

    def turn(self, longest: float) -> None:
        """Wait for at most `longest` seconds, then call what is due."""
        timers = self._timers
        if timers:
            left = timers[0][0] - self.clock()
            if left < longest:
                longest = left if left > 0 else 0
        for descriptor, events in self._epoll.poll(longest, _EVENTS_PER_TURN):
            handler = self._handlers.get(descriptor)
            if handler is not None:
                handler(events)
        if timers and timers[0][0] <= self.clock():
            self._call_due()
        if self._discarded:
            self._close_discarded()

    def close(self) -> None:
        """Release the epoll descriptor and every discarded socket."""
        self._close_discarded()
        self._handlers.clear()
        self._epoll.close()

    def _call_due(self) -> None:
        now = self.clock()
        while self._timers and self._timers[0][0] <= now:
            callback = heapq.heappop(self._timers)[2].callback
            if callback is not None:
                callback()

    def _close_discarded(self) -> None:
        for sock in self._discarded:
            sock.close()
        self._discarded.clear()
