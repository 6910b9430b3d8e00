"""Drivers of engines for tests: no thread calls their turns (`appliance/base/engine_thread.py`)."""

import asyncio
import contextlib
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from appliance.audit.log import AuditLog
from appliance.base import clock
from appliance.base.engine_thread import Turn
from appliance.store.writer_thread import Database
from tests.support.virtual_clock import VirtualClock


class ByHand:
    """Calls turns only while a caller waits; otherwise the test calls them, with `let_pass`."""

    def __init__(self, _name: str, turn: Turn, _gather: float) -> None:
        self._turn = turn
        self._wanted = False
        self._due: float | None = None
        self._turning = threading.Lock()
        self.hurry()

    def wake(self) -> None:
        """Leave new work to a later turn, unless it comes during one."""
        if self._turning.locked():
            self._wanted = True

    def hurry(self) -> None:
        """Call the turns that are due. A call during a turn, also in another thread, has them called after it."""
        self._wanted = True
        while self._wanted and self._turning.acquire(blocking=False):
            try:
                self._wanted = False
                now = clock.now()
                self._due = self._turn(now)
                while self._due is not None and self._due <= now:
                    self._due = self._turn(now)
            finally:
                self._turning.release()

    def end(self, _seconds: float | None) -> bool:
        """Call the turns that are left."""
        self.hurry()
        return self._due is None


class Inline(ByHand):
    """Calls a turn with new work, before the call that brought the work returns."""

    def wake(self) -> None:
        """Call the turns that are due."""
        super().hurry()

    def hurry(self) -> None:
        """Call the turns that are due, and the next one when it is: a log that failed answers only then."""
        super().hurry()
        if self._due is not None and self._due < math.inf:
            with contextlib.suppress(RuntimeError):  # no loop runs
                loop = asyncio.get_running_loop()
                loop.call_later(self._due - clock.now(), super().hurry)


def let_pass(engine: AuditLog | Database, time: VirtualClock, seconds: float) -> None:
    """Let time pass, and call the turns of an engine as they become due."""
    end = clock.now() + seconds
    due = engine.turn(clock.now())
    while due is not None and due <= end:
        time.advance(due - clock.now())
        due = engine.turn(clock.now())
    time.advance(end - clock.now())


def open_log(path: Path, **settings: Any) -> AuditLog:
    """Open an audit log that writes each record at once, without a thread."""
    return AuditLog(path, drive=Inline, **settings)


class InlineDatabase(Database):
    """A state file that writes each change at once, without a thread."""

    def __init__(self, path: Path, schema: str, *, failed: Callable[[str], None]) -> None:
        super().__init__(path, schema, failed=failed, drive=Inline)
