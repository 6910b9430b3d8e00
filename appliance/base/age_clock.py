"""The clock by which ages are counted: what is kept for so many days goes when these have passed.

A machine's clock may be years off after a start, or set by mistake, until somebody or a time service puts it right.
Whoever removes what is old would have removed everything by then.

Invariants:

1. While the process runs, what passes is what the monotonic clock says: nothing that is set counts, and it never goes
   back.
2. How long it was off only the machine's clock says. Up to `_AT_ONCE` counts at once; more counts when the clock has
   stood so far ahead for `_STANDS` of running, by the least that it was meanwhile. A clock that is behind counts for
   nothing until it is put right.
3. It goes on over restarts: its file is written every `_SAVE`, and what was lost of it counts as time off.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
import structlog

from appliance.base.atomic_files import write_whole

_DAY = 86_400_000_000_000
_AT_ONCE = 3 * _DAY  # a long weekend
_STANDS = _DAY
_SAVE = 600_000_000_000
_log = structlog.get_logger()


class _Kept(msgspec.Struct):
    """All in nanoseconds."""

    lived: int  # that the machine ran with the process
    credited: int  # beside `lived`, what counts as passed: since the epoch
    believed: int  # what the machine's clock said beyond `lived` when that was looked at last
    sets: int = 0  # what of it was set while the process ran, and did not count
    step: int = 0  # how far it stood from there at the start, as long as that does not count
    since: int = 0  # `lived` when that was seen first


def _monotonic() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)  # a suspended machine's time passes, too


class AgeClock:
    """Nanoseconds since the epoch where the machine's clock was never wrong; kept in the file at `path`.

    Where there is no such file it begins at `begin()`, or now. Raises `OSError` where it cannot be read.
    """

    def __init__(
        self,
        path: Path,
        begin: Callable[[], int | None] = lambda: None,
        *,
        wall: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], int] = _monotonic,
    ) -> None:
        self._path = path
        self._wall = wall
        self._monotonic = monotonic
        self._seen = monotonic()
        self._saved = -_SAVE
        self._open = True  # it is not known yet how long it was off
        try:
            self._kept = msgspec.json.decode(path.read_bytes(), type=_Kept)
        except (FileNotFoundError, msgspec.MsgspecError) as error:
            if not isinstance(error, FileNotFoundError):
                _log.warning("what is known of ages cannot be read: they are counted anew", file=str(path))
            now = wall()
            self._kept = _Kept(0, begin() or now, now)

    def __call__(self) -> int:
        """What it is now."""
        kept, seen = self._kept, self._monotonic()
        kept.lived += seen - self._seen
        self._seen = seen
        stood, ahead = bool(kept.step), self._wall() - kept.lived - kept.believed
        if self._open:
            self._was_off(ahead)
        else:
            moved = max(ahead, -kept.sets)
            kept.believed += moved
            kept.sets += moved
        if bool(kept.step) is not stood or kept.lived - self._saved >= _SAVE:
            self._saved = kept.lived
            with suppress(OSError):  # a full disk: it is tried again
                write_whole(self._path, msgspec.json.encode(kept), 0o600)
        return kept.lived + kept.credited

    def _was_off(self, ahead: int) -> None:
        """By the machine's clock it was off for so long."""
        kept, counts = self._kept, 0
        if abs(ahead) <= _AT_ONCE:
            kept.step, counts = 0, max(0, ahead)
            kept.believed += counts
        else:
            if kept.step * ahead <= 0:
                kept.step, kept.since = ahead, kept.lived
            kept.step = min(kept.step, ahead, key=abs)
            if kept.step > 0 and kept.lived - kept.since >= _STANDS:
                kept.step, counts = 0, kept.step
                kept.believed += ahead
        kept.credited += counts
        self._open = bool(kept.step)
