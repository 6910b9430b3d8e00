"""The clock of ages: what passes counts, and no step of the machine's clock before it has stood."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from appliance.base.age_clock import AgeClock

HOUR = 3600 * 1_000_000_000
DAY = 24 * HOUR
YEAR = 365 * DAY
BEGIN = 20_000 * DAY


@dataclass
class Machine:
    """A machine whose clock the test sets: `true` is what time it is, `wrong` how far its clock is off."""

    path: Path
    true: int = BEGIN
    wrong: int = 0

    def begin(self) -> None:
        """The process starts."""
        started = self.true
        self.age = AgeClock(
            self.path, wall=lambda: self.true + self.wrong, monotonic=lambda: self.true - started
        )
        self.age()

    def run(self, duration: int) -> int:
        """It runs, and the clock of ages is looked at now and then: what that says in the end."""
        for _ in range(8):
            self.true += duration // 8
            self.age()
        return self.age()

    def off(self, duration: int) -> None:
        """The machine is off, and starts again."""
        self.true += duration
        self.begin()


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    """A new one, with the right time."""
    machine = Machine(tmp_path / "age")
    machine.begin()
    yield machine
    assert machine.age() <= machine.true + 3 * HOUR  # what is kept for so long is kept at least as long


def test_with_a_right_clock_it_is_the_time(machine: Machine) -> None:
    """Running, off over night and over a long weekend."""
    for hours in (16, 16, 71, 16):
        machine.run(8 * HOUR)
        machine.off(hours * HOUR)
    assert abs(machine.age() - machine.true) < HOUR


def test_what_is_set_while_it_runs_counts_for_nothing(machine: Machine) -> None:
    """However long it stays so; and what was off before and after counts."""
    for wrong in (YEAR, 0, -YEAR, 0, 20 * YEAR, 0):
        machine.wrong = wrong
        machine.run(30 * HOUR)
        machine.off(16 * HOUR)
    assert abs(machine.run(HOUR) - machine.true) < DAY


def test_a_wrong_clock_at_a_start_that_is_put_right_counts_for_nothing(machine: Machine) -> None:
    """Within a day of running, also when it is put right while the appliance is off."""
    for wrong in (YEAR, 7 * DAY, -YEAR):
        machine.wrong = wrong
        machine.off(16 * HOUR)
        machine.run(8 * HOUR)
        machine.off(HOUR)
        machine.run(8 * HOUR)
        machine.wrong = 0
        machine.off(HOUR)
        assert abs(machine.run(HOUR) - machine.true) < DAY


def test_a_clock_of_a_wrong_zone_at_each_start_adds_nothing_up(machine: Machine) -> None:
    """The hardware's clock has local time, which is put right a moment later."""
    for _ in range(100):
        machine.wrong = 2 * HOUR
        machine.off(16 * HOUR)
        machine.wrong = 0
        machine.run(8 * HOUR)
        assert abs(machine.age() - machine.true) <= 2 * HOUR
    machine.off(16 * HOUR)


def test_a_new_robot_whose_first_date_was_put_right(machine: Machine) -> None:
    """It ran for weeks in 1970 and found a time service then: nothing of it is fifty years old."""
    machine.path.unlink()
    machine.wrong = 60 * DAY - machine.true
    machine.begin()
    began = machine.age()
    machine.run(20 * DAY)
    machine.wrong = 0
    machine.run(20 * DAY)
    assert abs(machine.age() - began - 40 * DAY) < HOUR


def test_a_clock_that_begins_in_the_past_at_each_start_is_no_leap(machine: Machine) -> None:
    """No battery: it is 1970 until a time service puts it right, twenty times."""
    for _ in range(20):
        machine.off(16 * HOUR)
        machine.wrong = -machine.true
        machine.run(HOUR // 6)
        machine.wrong = 0
        machine.run(8 * HOUR)
    assert abs(machine.age() - machine.true) < DAY


def test_a_long_time_off_counts_after_a_day_of_running(machine: Machine) -> None:
    """It cannot be told from a clock that is wrong; in the end it is believed."""
    machine.off(90 * DAY)
    assert machine.run(20 * HOUR) < BEGIN + 2 * DAY
    machine.off(2 * HOUR)
    assert abs(machine.run(6 * HOUR) - machine.true) < DAY


def test_of_a_step_that_varies_the_least_counts(machine: Machine) -> None:
    """A clock that jumps about is believed no further than it stood all day."""
    machine.wrong = YEAR
    machine.off(10 * DAY)
    for wrong in (YEAR, 9 * YEAR, 2 * YEAR, 0):
        machine.wrong = wrong
        machine.run(7 * HOUR)
    assert abs(machine.age() - machine.true) < DAY


def test_it_never_goes_back(machine: Machine) -> None:
    """Whatever is set, and over restarts."""
    last = machine.age()
    for wrong in (-YEAR, 0, -20 * YEAR, 0, HOUR):
        machine.wrong = wrong
        machine.off(HOUR)
        now = machine.run(30 * HOUR)
        assert now >= last + 30 * HOUR
        last = now


@pytest.mark.parametrize("left", [b"", b"{", b'{"lived":"x"}'])
def test_a_file_that_is_spoilt_begins_anew(tmp_path: Path, left: bytes) -> None:
    """A power cut leaves anything: it goes on from what is known to have been, not from a clock that may be wrong."""
    path = tmp_path / "age"
    path.write_bytes(left)
    assert abs(AgeClock(path, lambda: BEGIN, wall=lambda: BEGIN + YEAR, monotonic=lambda: 7)() - BEGIN) < HOUR


def test_a_full_disk_does_not_stop_it(tmp_path: Path) -> None:
    """What cannot be kept is counted on."""
    machine = Machine(tmp_path / "gone" / "age")
    machine.begin()
    assert machine.run(DAY) == machine.true
