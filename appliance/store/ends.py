"""Keep the end of everything that ends: tokens, tickets, blocks, timed switches, silences, sessions, approvals.

1. An end is a time of the age clock (`base/age_clock.py`): a step of the system clock moves none while control runs.
2. Neither a restart nor a takeover gives an end more time. At a start, all stored ends move together: by the difference
   of both appliances' clocks, or back by the time that a killed process had not saved.
3. A right may end too early, and never too late: a long time off, which the age clock counts only later, counts at
   once for it. An end that is `late`, as that of a block, is never too early.
4. A credential is `dated`: it also ends when the system clock shows its date. Only so time off counts on a machine
   whose clock is right only some time after its start. One that is made while the clock is behind the program's own
   files gets its date once the clock is set, or is dated from those files after a restart.
5. `is_over` is exact. The owner of a kind is called soon after an end, and again until it forgets or sets the end.

6. An end by the system clock, before the time that was counted, is reported (`when_cut_short`).

The names of kinds are stored, so a kind keeps its name.
"""

import asyncio
import contextlib
import math
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import structlog

from appliance.base import clock
from appliance.base.age_clock import AgeClock
from appliance.base.shipped import before_program
from appliance.store.state_file import EndRow, StateStore
from appliance.store.writer_thread import StoreError, require_0_4

_READING = "reading of the clocks"
_MARK = "ends"  # this setting exists in each state that a version from 0.4 on has opened
_SECOND = 1_000_000_000
_NOTE_SECONDS = 30.0
_PAIRED_NOTE_SECONDS = 1.0  # at each look, unless many come together
LOOK_SECONDS = 5.0
"""The longest time between two checks: timers do not count while the machine is suspended, the age clock does."""
_CUT_SHORT = 60 * _SECOND  # clocks that are not set differ by less
_SAME_DATE = _SECOND  # a smaller difference of the clocks moves no date that people see

_log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class EndKind:
    """A kind of things that end; each has a name that is unique in its kind."""

    name: str
    late: bool = False
    """Whether it may end too late, and never too early: it protects. All others give a right, or lift a protection."""
    stored: bool = True
    """Whether it survives a restart of control."""
    dated: bool = False
    """Whether its date ends it too: a credential."""


class _Reading(msgspec.Struct, frozen=True):
    """The system clock (seconds since the epoch) and the age clock (nanoseconds) of an appliance."""

    appliance: str
    wall: float
    age: int


class _End(NamedTuple):
    at: int
    since: int
    late: bool
    stored: bool
    date: int | None  # by the system clock
    undated: bool = False  # the system clock was not set yet: `date` is only for a later start


class EndTable:
    """All ends. Make it before any part reads them.

    `appliance` is the name of one of two appliances. `away_seconds` is for a takeover: the time since this appliance
    followed the other one; None: it did not.
    """

    def __init__(
        self,
        store: StateStore,
        age: AgeClock,
        *,
        appliance: str = "",
        away_seconds: float | None = None,
        behind: Callable[[], float] = before_program,
    ) -> None:
        """`behind()` returns the seconds by which the system clock is behind any possible time; 0: it may be right."""
        self._store = store
        self._behind = behind
        self._cut_short: Callable[[str, str, float], object] = lambda _kind, _name, _seconds: None
        self._age = age
        self._appliance = appliance
        self._calls: dict[str, Callable[[list[str]], object]] = {}
        self._changed = asyncio.Event()
        self._noted = -math.inf
        self.read_clock()
        self._offset = clock.wall_ns() - self._now()  # the system clock minus the age clock
        self._ends: dict[str, dict[str, _End]] = {}
        with store.database.together():
            self._begin(away_seconds)

    # --- setting ends ---

    def set(self, kind: EndKind, name: str, seconds: float) -> None:
        now, length = self._now(), int(seconds * _SECOND)
        behind = int(self._behind() * _SECOND) if kind.dated else 0
        date = clock.wall_ns() + behind + length if kind.dated else None
        self._put(kind.name, name, _End(now + length, now, kind.late, kind.stored, date, undated=behind > 0))

    def forget(self, kind: EndKind, *names: str) -> None:
        for name in names:
            end = self._ends.get(kind.name, {}).pop(name, None)
            if end is None:
                continue
            if end.stored:
                self._store.forget_end(kind.name, name)
            left = end.at - self._now()
            if left > _CUT_SHORT and self._time_left(end) <= 0:
                self._cut_short(kind.name, name, left / _SECOND)

    def undo(self, kind: EndKind) -> Callable[[], None]:
        """Return a function that sets the ends of a kind as they are now."""
        kept = dict(self._ends.get(kind.name, {}))

        def restore() -> None:
            self.forget(kind, *(name for name in self.names(kind) if name not in kept))
            for name, end in kept.items():
                self._put(kind.name, name, end)

        return restore

    # --- reading ends ---

    def is_over(self, kind: EndKind, name: str) -> bool:
        """Whether the end has passed, or none is set: a thing whose end is lost is over."""
        end = self._ends.get(kind.name, {}).get(name)
        return end is None or self._time_left(end) <= 0

    def time_left(self, kind: EndKind, name: str) -> float | None:
        """Return the seconds until the end, 0 after it, or None if none is set."""
        end = self._ends.get(kind.name, {}).get(name)
        return None if end is None else max(0.0, self._time_left(end) / _SECOND)

    def date(self, kind: EndKind, name: str) -> float | None:
        """Return the end in seconds since the epoch by the present system clock, for people."""
        end = self._ends.get(kind.name, {}).get(name)
        if end is None:
            return None
        offset = clock.wall_ns() - self._now()
        if abs(offset - self._offset) > _SAME_DATE:
            self._offset = offset
        by_age = end.at + self._offset
        return (by_age if end.date is None or end.undated else min(end.date, by_age)) / _SECOND

    def system_time(self) -> float | None:
        """Return seconds since the epoch, or None while the system clock is behind any possible time."""
        return None if self._behind() else clock.wall()

    def names(self, kind: EndKind) -> list[str]:
        return list(self._ends.get(kind.name, {}))

    def next_due(self) -> float | None:
        """Return the seconds until the next end, or None without one."""
        left = [left for end in self._all() if (left := self._time_left(end)) > 0]
        return min(left) / _SECOND if left else None

    # --- calling the owners ---

    def when_due(self, kind: EndKind, call: Callable[[list[str]], object]) -> None:
        """Call `call(names)` when ends have passed, and without names when dates have changed. It must not wait."""
        self._calls[kind.name] = call

    def when_cut_short(self, call: Callable[[str, str, float], object]) -> None:
        """Call `call(kind, name, seconds)` for each thing that the system clock ended, with its time left otherwise.

        The clock was set forward, or shows that the appliance was off for long.
        """
        self._cut_short = call

    async def run(self) -> None:
        while True:
            self._changed.clear()
            await asyncio.to_thread(self.read_clock)
            self.look()
            left = self.next_due()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_SECONDS if left is None else min(left, LOOK_SECONDS)):
                    await self._changed.wait()

    def read_clock(self) -> None:
        """Read the age clock, which may write a file. Only one thread at a time may call this."""
        age, boot = self._age(), clock.since_boot_ns()
        self._age_at_boot = age - boot

    def look(self) -> None:
        """Call the owners of all ends that have passed, and note the clocks from time to time."""
        self._count_time_off()
        self._date_late()
        for kind, call in self._calls.items():
            due = [name for name, end in self._ends.get(kind, {}).items() if self._time_left(end) <= 0]
            try:
                if due:
                    call(due)
            except Exception as error:  # noqa: BLE001  a defect of one kind must not keep others from ending
                _log.critical("fault at an end", kind=kind, names=due[:20], exc_info=error)
        if clock.since_boot() - self._noted >= (_PAIRED_NOTE_SECONDS if self._appliance else _NOTE_SECONDS):
            self._noted = clock.since_boot()
            with contextlib.suppress(StoreError):  # a full disk: a queued row each time would only grow
                self._store.database.require_room()
                self._note()

    # --- inside ---

    def _now(self) -> int:
        return self._age_at_boot + clock.since_boot_ns()

    def _time_left(self, end: _End) -> int:
        uncounted = 0 if end.late else self._age.uncounted_time(end.since)
        left = end.at - self._now() - uncounted
        return left if end.date is None or end.undated else min(left, end.date - clock.wall_ns())

    def _all(self) -> Iterator[_End]:
        return (end for ends in self._ends.values() for end in ends.values())

    def _put(self, kind: str, name: str, end: _End) -> None:
        self._ends.setdefault(kind, {})[name] = end
        if end.stored:
            self._store.save_end(_row(kind, name, end))
        self._changed.set()

    def _count_time_off(self) -> None:
        """Move the ends that were set while a long time off did not count yet: they began after it."""
        for kind, ends in self._ends.items():
            for name, end in list(ends.items()):
                if added := self._age.true_date(end.since) - end.since:
                    self._put(kind, name, end._replace(at=end.at + added, since=self._now()))

    def _date_late(self) -> None:
        """Date the ends that were set before the system clock was, once it is set."""
        if self._behind():
            return
        for kind, ends in self._ends.items():
            undated = [(name, end) for name, end in ends.items() if end.undated]
            for name, end in undated:
                date = clock.wall_ns() + end.at - self._now()
                self._put(kind, name, end._replace(date=date, undated=False))
            if undated and kind in self._calls:
                self._calls[kind]([])

    def _begin(self, away_seconds: float | None) -> None:
        settings, now = self._store.settings(), self._now()
        text = settings.get(_READING)
        last = None if text is None else msgspec.json.decode(text, type=_Reading)
        # A standby that left its pair also has the ends of the other appliance, by its clock.
        taken_over = last is not None and last.appliance not in ("", self._appliance)
        if _MARK not in settings:
            require_0_4(self._store.database.query)
            self._store.save_setting(_MARK, "1")
        for row in self._store.ends():
            end = _End(row.at, row.since, bool(row.late), stored=True, date=row.date)
            if last is not None and taken_over:
                end = _inherit(end, last, away_seconds, now)
            elif last is not None and now < last.age:
                end = end._replace(at=end.at + now - last.age, since=end.since + now - last.age)
            self._ends.setdefault(row.kind, {})[row.name] = end
            if row != _row(row.kind, row.name, end):
                self._store.save_end(_row(row.kind, row.name, end))
        self._note()

    def _note(self) -> None:
        reading = _Reading(self._appliance, clock.wall(), self._now())
        self._store.save_setting(_READING, msgspec.json.encode(reading).decode())


def replicated_ends(connection: sqlite3.Connection, kind: EndKind) -> dict[str, tuple[int, float]]:
    """Return the stored end of each name, and the seconds left when the active appliance last read its clock."""
    reading = connection.execute("SELECT value FROM setting WHERE name = ?", (_READING,)).fetchone()
    if reading is None:
        return {}
    last = msgspec.json.decode(reading[0], type=_Reading)
    rows = connection.execute("SELECT name, at, date FROM ends WHERE kind = ?", (kind.name,))
    return {
        name: (at, min((at - last.age) / _SECOND, math.inf if date is None else date / _SECOND - last.wall))
        for name, at, date in rows
    }


def _row(kind: str, name: str, end: _End) -> EndRow:
    return EndRow(kind, name, end.at, end.since, int(end.late), end.date)


def _inherit(end: _End, last: _Reading, away_seconds: float | None, now: int) -> _End:
    """Return the end of another appliance, with its last reading, by the clocks of this one.

    If this appliance did not follow the other one before, the difference of the clocks may include time off. Then an
    end that may be late continues from the last reading, and a right has no more time than by either clock.
    """
    ahead = now - last.age
    if away_seconds is not None:
        away, date = int(away_seconds * _SECOND), end.date
        if date is not None:
            # The earlier system clock may not have been set when it was dated.
            by_age = clock.wall_ns() + end.at - last.age - away
            date = min(date + clock.wall_ns() - int(last.wall * _SECOND) - away, by_age)
        return end._replace(at=end.at + ahead - away, since=now, date=date)
    if end.late:
        return end._replace(at=end.at + ahead, since=now)
    moved = min(ahead, 0)
    return end._replace(at=end.at + moved, since=end.since + moved)
