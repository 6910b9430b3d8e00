"""Machines whose clocks are wrong, that restart and that rest, for tests of data that is dated by the age clock.

`ages_of` makes data at each time of a history, and then checks that it is kept for its whole time and not for ever.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol
from unittest import mock

from appliance.base import age_clock
from appliance.base.age_clock import AgeClock

HOUR = 3600 * 1_000_000_000
DAY = 24 * HOUR
YEAR = 365 * DAY
KEPT = 30 * DAY
_LONGEST = 250 * DAY  # the rests in a history, and then its time

Step = tuple[str, int]  # what happens, and nanoseconds

HISTORIES: dict[str, list[Step]] = {
    "a machine that never stops": [("run", 3 * DAY)],
    "restarts": [("run", 8 * HOUR), ("off", HOUR), ("run", 8 * HOUR), ("off", 16 * HOUR), ("run", 8 * HOUR)],
    "a clock that is an hour ahead": [("set", HOUR), ("off", HOUR), ("run", 8 * HOUR), ("set", 0), ("run", 8 * HOUR)],
    "a clock that is an hour behind": [("set", -HOUR), ("off", HOUR), ("run", 8 * HOUR), ("set", 0), ("run", HOUR)],
    "a clock that is a year ahead for half a day": [
        ("set", YEAR), ("off", HOUR), ("run", 12 * HOUR), ("set", 0), ("run", 8 * HOUR), ("off", HOUR), ("run", HOUR),
    ],
    "a clock that is a year behind": [("set", -YEAR), ("off", HOUR), ("run", 3 * DAY), ("set", 0), ("run", DAY)],
    "a change by a year while it runs": [("run", HOUR), ("set", YEAR), ("run", DAY), ("set", -YEAR), ("run", DAY)],
    "a rest longer than the retention": [("run", 8 * HOUR), ("off", 90 * DAY), ("run", 20 * HOUR), ("run", 20 * HOUR)],
    "a long rest and restarts on the first day": [
        ("off", 90 * DAY), ("run", 6 * HOUR), ("off", HOUR), ("run", 6 * HOUR), ("off", HOUR), ("run", 20 * HOUR),
    ],
    "two long rests": [("off", 90 * DAY), ("run", 30 * HOUR), ("off", 60 * DAY), ("run", 20 * HOUR), ("run", DAY)],
}  # fmt: skip


class Keeper(Protocol):
    """Data that is dated by an age clock, and removed after `KEPT`. It is made again at each start of its process."""

    def make(self) -> None: ...

    def is_due(self) -> bool:
        """Return whether the data would be removed now."""


class Machine:
    """A machine; `true` is the time and `wrong` the difference of its own clock from it."""

    def __init__(self, folder: Path, start: Callable[[Path, AgeClock], Keeper]) -> None:
        self._folder, self._start = folder, start
        self.true, self.wrong = 20_000 * DAY, 0
        self.begin()

    def begin(self) -> None:
        booted = self.true
        age = AgeClock(
            self._folder / "age", wall=lambda: self.true + self.wrong, monotonic=lambda: self.true - booted
        )
        age()
        self.keeper = self._start(self._folder, age)
        self._age = age

    def take(self, step: Step) -> None:
        kind, amount = step
        match kind:
            case "set":
                self.wrong = amount
            case "off":
                self.true += amount
                self.begin()
            case _:
                parts = max(2, amount // (4 * HOUR))
                for _ in range(parts):
                    self.true += amount // parts
                    self._age()


def ages_of(folder: Path, start: Callable[[Path, AgeClock], Keeper], history: str) -> list[str]:
    """Return in words which data of this history is removed too early, or is never removed."""
    with mock.patch.object(age_clock, "write_whole", lambda path, data, _mode: path.write_bytes(data)):
        return list(_ages_of(folder, start, HISTORIES[history]))


def _ages_of(folder: Path, start: Callable[[Path, AgeClock], Keeper], steps: list[Step]) -> Iterator[str]:
    for number in range(len(steps) + 1):
        place = folder / str(number)
        place.mkdir()
        machine = Machine(place, start)
        for step in steps[:number]:
            machine.take(step)
        machine.keeper.make()
        made = machine.true
        for step in steps[number:]:
            machine.take(step)
        machine.wrong = 0
        while not machine.keeper.is_due() and machine.true - made < _LONGEST:
            machine.take(("run", 8 * HOUR))
            machine.take(("off", 16 * HOUR))
        after = (machine.true - made) / DAY
        if after < KEPT / DAY - 1 / 4:
            yield f"data made after step {number} is removed after {after:.1f} days"
        if machine.true - made >= _LONGEST:
            yield f"data made after step {number} is kept for {after:.1f} days"
