"""Run an engine in a thread of its own, or in its caller's.

The `turn(now)` of an engine does the work that is due, and returns the time of the next turn, or None after the
last one. All times are in monotonic seconds.
"""

import contextvars
import threading
from collections.abc import Callable
from typing import Protocol

from appliance.base.clock import now

Turn = Callable[[float], float | None]


class Driver(Protocol):
    """Calls the turns of one engine. Thread-safe."""

    def wake(self) -> None:
        """Call the engine soon, because it has new work."""

    def hurry(self) -> None:
        """Call the engine at once, because a caller waits for the work."""

    def end(self, seconds: float | None) -> bool:
        """End the engine; return whether it ended within `seconds`."""


Drive = Callable[[str, Turn, float], Driver]
"""Starts the engine with this name, and returns its driver after the first turn.

After `wake`, the driver gathers work for the given number of seconds.
"""


class EngineThread:
    """Runs an engine in a thread, which a defect of the engine also ends."""

    def __init__(self, name: str, turn: Turn, gather: float) -> None:
        self._turn = turn
        self._gather = gather
        self._wake = threading.Event()
        self._hurry = threading.Event()
        self._begun = threading.Event()
        context = contextvars.copy_context()  # the name of this process, and its clock
        self._thread = threading.Thread(target=context.run, args=(self._run,), name=name, daemon=True)
        self._thread.start()
        self._begun.wait()

    def wake(self) -> None:
        if not self._wake.is_set():  # `set` takes a lock
            self._wake.set()

    def hurry(self) -> None:
        self._hurry.set()
        self._wake.set()

    def end(self, seconds: float | None) -> bool:
        self.hurry()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            due = self._turn(now())
        finally:
            self._begun.set()
        while due is not None:
            left = due - now()
            if left > 0 and self._wake.wait(min(left, threading.TIMEOUT_MAX)):
                self._hurry.wait(self._gather)
            # Clear both before the turn: work that comes during the turn sets them again.
            self._hurry.clear()
            self._wake.clear()
            due = self._turn(now())


class InCaller:
    """Runs an engine in its only caller's thread: at the start, at the end, and when the caller waits."""

    def __init__(self, _name: str, turn: Turn, _gather: float) -> None:
        self._turn = turn
        self.due: float | None = None
        self.hurry()

    def wake(self) -> None: ...

    def hurry(self) -> None:
        time = now()
        self.due = self._turn(time)
        while self.due is not None and self.due <= time:
            self.due = self._turn(time)

    def end(self, _seconds: float | None) -> bool:
        self.hurry()
        return self.due is None
