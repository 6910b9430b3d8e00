"""Write the log of a process: a log that cannot be written neither fails nor delays the work that it reports.

1. `write` and `flush` raise nothing and wait for no reader, once `keep_from_blocking` has the descriptor.
2. Lines that cannot be written wait in memory, in their order. Beyond `MAX_WAITING` bytes, lines are only counted.
3. The waiting lines are tried again with each new line and twice a second. After them, a line has the number of lost
   lines.
"""

import io
import os
import stat
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TextIO, cast

from appliance.base.clock import utc_now
from appliance.base.engine_thread import Drive, EngineThread

MAX_WAITING = 256 << 10
_AGAIN_SECONDS = 0.5


class LogOutput(io.TextIOBase):
    """Standard error of a process. `lost` makes the line that reports a number of lost lines, and since when.

    `drive` is called when a line cannot be written.
    """

    encoding = "utf-8"
    errors = "backslashreplace"

    def __init__(self, descriptor: int, lost: Callable[[int, str], str], drive: Drive = EngineThread) -> None:
        self._descriptor = descriptor
        self._report = lost
        self._drive = drive
        self._waiting: deque[bytes] = deque()
        self._size = 0
        self._lost, self._lost_since = 0, ""
        self._lock = threading.RLock()  # reentrant: a signal's handler may log while its thread does
        self._sending = self._retrying = False
        os.register_at_fork(after_in_child=self._on_fork)

    def _on_fork(self) -> None:
        self._lock = threading.RLock()  # a thread that the child does not have may hold the other

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        data = text.encode(self.encoding, self.errors)
        with self._lock:
            if self._waiting and (self._lost or self._size + len(data) > MAX_WAITING):
                self._lost_since = self._lost_since or utc_now().isoformat(timespec="seconds")
                self._lost += data.count(b"\n")
            elif data:
                self._waiting.append(data)
                self._size += len(data)
            self._send()
            begins = bool(self._waiting) and not self._retrying
            self._retrying = self._retrying or begins
        if begins:
            self._retry()
        return len(text)

    def flush(self) -> None:
        with self._lock:
            self._send()

    def _retry(self) -> None:
        try:
            self._drive("log", self._turn, 0.0)
        except RuntimeError:  # no more threads: the next line tries it again
            self._retrying = False

    def _turn(self, now: float) -> float | None:
        with self._lock:
            self._send()
            self._retrying = bool(self._waiting)
            return now + _AGAIN_SECONDS if self._retrying else None

    def _send(self) -> None:
        if self._sending:
            return
        self._sending = True
        try:
            while self._waiting or self._lost:
                if not self._waiting:
                    line = self._report(self._lost, self._lost_since).encode(self.encoding, self.errors)
                    self._lost, self._lost_since = 0, ""
                    self._waiting.append(line)
                    self._size += len(line)
                written = os.write(self._descriptor, self._waiting[0])
                self._size -= written
                rest = self._waiting[0][written:]
                if rest:  # a full pipe or disk took a part
                    self._waiting[0] = rest
                else:
                    self._waiting.popleft()
        except OSError:
            pass  # full, closed, or its reader does not read
        finally:
            self._sending = False


def replace_stderr(
    lost: Callable[[int, str], str], drive: Drive = EngineThread, *, waits: bool = False
) -> TextIO:
    """Let `sys.stderr` be a `LogOutput` for all that writes to it: loggers, warnings, tracebacks of threads.

    Unless it `waits`, no write to standard output or error waits for a reader. A `sys.stderr` that is not the
    process's own stays.
    """
    present = sys.stderr
    is_own = present is sys.__stderr__
    if not (is_own or isinstance(present, LogOutput)):
        return present
    with suppress(OSError):
        present.flush()
    if not waits:
        for descriptor in (1, 2):
            keep_from_blocking(descriptor)
    output = cast(TextIO, LogOutput(2, lost, drive))
    sys.stderr = output
    return output


def keep_from_blocking(descriptor: int) -> None:
    """Let writes to a pipe, socket or terminal fail when its reader does not read.

    A pipe or terminal is opened again, because other programs share the open file, such as the shell's.
    """
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISREG(kind):
        return
    own = -1
    if not stat.S_ISSOCK(kind):
        with suppress(OSError):  # it belongs to another user, or has no reader now
            own = os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    if own < 0:
        os.set_blocking(descriptor, False)
        return
    os.dup2(own, descriptor)
    os.close(own)
