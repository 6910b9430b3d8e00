import asyncio
import contextlib
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from appliance.audit.log.log import AuditLog
from appliance.base import clock
from appliance.base.engine_thread import InCaller, Turn
from appliance.store.writer_thread import Database
from tests.support.virtual_clock import VirtualClock


class ByHand(InCaller):
    def __init__(self, name: str, turn: Turn, gather: float) -> None:
        self._wanted = False
        self._turning = threading.Lock()
        super().__init__(name, turn, gather)

    def wake(self) -> None:
        if self._turning.locked():
            self._wanted = True

    def hurry(self) -> None:
        """Take the turns that are due. A call during a turn, even from another thread, causes another turn."""
        self._wanted = True
        while self._wanted and self._turning.acquire(blocking=False):
            try:
                self._wanted = False
                super().hurry()
            finally:
                self._turning.release()


class Inline(ByHand):
    def wake(self) -> None:
        super().hurry()

    def hurry(self) -> None:
        super().hurry()
        if self.due is not None and self.due < math.inf:
            with contextlib.suppress(RuntimeError):  # no loop runs
                loop = asyncio.get_running_loop()
                loop.call_later(self.due - clock.now(), super().hurry)


def let_pass(engine: AuditLog | Database, seconds: float) -> None:
    time = clock.source()
    assert isinstance(time, VirtualClock)
    end = clock.now() + seconds
    due = engine.turn(clock.now())
    while due is not None and due <= end:
        time.advance(due - clock.now())
        due = engine.turn(clock.now())
    time.advance(end - clock.now())


def open_log(path: Path, **settings: Any) -> AuditLog:
    return AuditLog(path, drive=Inline, **settings)


class InlineDatabase(Database):
    def __init__(self, path: Path, schema: str, *, failed: Callable[[str], None]) -> None:
        super().__init__(path, schema, failed=failed, drive=Inline)


class KilledError(BaseException):
    """Control was killed."""
