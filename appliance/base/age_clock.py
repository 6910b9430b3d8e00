"""A clock for the age of kept data, robust against wrong system time.

1. While the process runs, the age clock follows the monotonic clock, whatever the system clock does.
2. Only the system clock shows how long the process was off. A gap of up to `_AT_ONCE` is added at once, a longer
   one after the system clock has been ahead for `_STANDS` of running time: then the smallest gap seen in that
   time. A system clock that is behind adds nothing until someone corrects it. If it is still behind at a later start,
   it may have been ahead before: the time since its latest reading counts, up to `_AT_ONCE`.
3. The state is saved every `_SAVE`; time since the last save counts as time off.
4. When a long gap is added later, `true_date` also adds it to the dates of data that was made in between.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from appliance.base.atomic_files import write_whole

_DAY = 86_400_000_000_000
_AT_ONCE = 3 * _DAY  # a long weekend
_STANDS = _DAY
_SAVE = 600_000_000_000
_log = structlog.get_logger()


class _Jump(msgspec.Struct, array_like=True):
    """A gap that was counted: dates from `first` to `last` by this clock are `added` too early."""

    first: int
    last: int
    added: int


class _Kept(msgspec.Struct):
    """The state of the clock; times are in nanoseconds."""

    lived: int  # running time of the machine while the process ran
    credited: int  # time since the epoch that counts in addition to `lived`
    believed: int  # the system clock minus `lived`, when last read
    sets: int = 0  # the sum of ignored changes of the system clock while the process ran
    step: int = 0  # the gap at the start, until it is counted
    since: int = 0  # `lived` when the gap was first seen
    jumps: list[_Jump] = []  # the gaps that were counted later than at once
    shown: int | None = None  # the system clock minus `lived`, by the latest reading, even if it is behind


class AgeClock:
    """Returns nanoseconds since the epoch, as if the system clock had never been wrong.

    Without the file `path`, the clock starts at `begin()`, or at the system time. Raises `OSError`.
    """

    def __init__(
        self,
        path: Path,
        begin: Callable[[], int | None] = lambda: None,
        *,
        wall: Callable[[], int] = clock.wall_ns,
        monotonic: Callable[[], int] = clock.since_boot_ns,
    ) -> None:
        self._path = path
        self._wall = wall
        self._monotonic = monotonic
        self._seen = monotonic()
        self._saved = -_SAVE
        self._starts = True
        self._open = True  # whether the time off is still unknown
        try:
            self._kept = msgspec.json.decode(path.read_bytes(), type=_Kept)
        except (FileNotFoundError, ValueError) as error:
            if not isinstance(error, FileNotFoundError):
                _log.warning("the saved ages cannot be read: they restart from zero", file=str(path))
            now = wall()
            self._kept = _Kept(0, begin() or now, now)

    def __call__(self) -> int:
        kept, seen = self._kept, self._monotonic()
        kept.lived += seen - self._seen
        self._seen = seen
        shown = self._wall() - kept.lived
        stood, off = bool(kept.step), self._advanced(shown)
        if self._starts and off and shown - kept.believed < -_AT_ONCE:
            kept.credited += off
            kept.believed += off
            kept.step, kept.sets, self._open = 0, 0, False
        ahead, self._starts = shown - kept.believed, False
        if self._open:
            self._was_off(ahead)
        else:
            moved = max(ahead, -kept.sets)
            kept.believed += moved
            kept.sets += moved
        if bool(kept.step) is not stood or kept.lived - self._saved >= _SAVE:
            self._saved = kept.lived
            with suppress(OSError):  # a full disk: the next save tries again
                write_whole(self._path, msgspec.json.encode(kept), 0o600)
        return kept.lived + kept.credited

    def true_date(self, date: int) -> int:
        """Return when data was made that got this date by the clock."""
        for jump in self._kept.jumps:
            if jump.first <= date <= jump.last:
                return date + jump.added
        return date

    def latest(self) -> int:
        """Return the latest time that it may be: with the time off that does not count yet."""
        return self() + max(0, self._kept.step)

    def uncounted_time(self, date: int) -> int:
        """Return the time off after this date by the clock that does not count yet, although it may be real."""
        return max(0, self._kept.step) if date < self._kept.since + self._kept.credited else 0

    def _advanced(self, shown: int) -> int:
        """Return by how much the system clock advanced since its latest reading; 0 if it was set by a longer time."""
        before = self._kept.shown
        if before is None or abs(shown - before) > _AT_ONCE:
            self._kept.shown = shown
            return 0
        self._kept.shown = max(before, shown)
        return self._kept.shown - before

    def _was_off(self, ahead: int) -> None:
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
                kept.jumps.append(_Jump(kept.since + kept.credited, kept.lived + kept.credited, counts))
        kept.credited += counts
        self._open = bool(kept.step)
