from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from appliance.base.age_clock import AgeClock
from tests.support.sources import ROOT

HOUR = 3600 * 1_000_000_000
DAY = 24 * HOUR
YEAR = 365 * DAY
BEGIN = 20_000 * DAY


@dataclass
class Machine:
    path: Path
    true: int = BEGIN
    wrong: int = 0

    def begin(self) -> None:
        started = self.true
        self.age = AgeClock(
            self.path, wall=lambda: self.true + self.wrong, monotonic=lambda: self.true - started
        )
        self.age()

    def run(self, duration: int) -> int:
        for _ in range(8):
            self.true += duration // 8
            self.age()
        return self.age()

    def off(self, duration: int) -> None:
        self.true += duration
        self.begin()


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path / "age")
    machine.begin()
    yield machine
    assert machine.age() <= machine.true + 3 * HOUR  # data is kept at least as long as configured


def test_it_follows_a_right_clock(machine: Machine) -> None:
    for hours in (16, 16, 71, 16):
        machine.run(8 * HOUR)
        machine.off(hours * HOUR)
    assert abs(machine.age() - machine.true) < HOUR


def test_a_change_while_running_is_ignored(machine: Machine) -> None:
    for wrong in (YEAR, 0, -YEAR, 0, 20 * YEAR, 0):
        machine.wrong = wrong
        machine.run(30 * HOUR)
        machine.off(16 * HOUR)
    assert abs(machine.run(HOUR) - machine.true) < DAY


def test_a_wrong_clock_corrected_within_a_day_is_ignored(machine: Machine) -> None:
    for wrong in (YEAR, 7 * DAY, -YEAR):
        machine.wrong = wrong
        machine.off(16 * HOUR)
        machine.run(8 * HOUR)
        machine.off(HOUR)
        machine.run(8 * HOUR)
        machine.wrong = 0
        machine.off(HOUR)
        assert abs(machine.run(HOUR) - machine.true) < DAY


def test_repeated_wrong_time_zones_do_not_add_up(machine: Machine) -> None:
    for _ in range(100):
        machine.wrong = 2 * HOUR
        machine.off(16 * HOUR)
        machine.wrong = 0
        machine.run(8 * HOUR)
        assert abs(machine.age() - machine.true) <= 2 * HOUR
    machine.off(16 * HOUR)


@pytest.mark.parametrize("zone", [0, 2 * HOUR])
def test_time_off_counts_after_a_clock_that_was_ahead_at_a_stop(machine: Machine, zone: int) -> None:
    """Only the first time off is unknown."""
    machine.wrong = YEAR
    machine.run(HOUR)
    machine.wrong = 0
    machine.off(16 * HOUR)
    lost = machine.true - machine.age()
    for hours in (16, 16, 71, 16):
        machine.wrong = 0
        machine.run(8 * HOUR)
        machine.wrong = zone
        machine.off(hours * HOUR)
    assert lost == 16 * HOUR
    assert abs(machine.true - machine.age() - lost) <= 2 * HOUR
    machine.wrong = 0
    machine.run(YEAR)
    machine.off(16 * HOUR)
    assert abs(machine.true - machine.age() - lost) <= 2 * HOUR


def test_time_off_of_a_clock_that_is_behind_counts_once(machine: Machine) -> None:
    machine.wrong = -YEAR
    for _ in range(5):
        machine.run(8 * HOUR)
        machine.off(16 * HOUR)
    machine.wrong = 0
    machine.run(8 * HOUR)
    machine.off(16 * HOUR)
    machine.run(30 * HOUR)
    assert abs(machine.age() - machine.true) < DAY


def test_a_new_robot_with_a_corrected_date(machine: Machine) -> None:
    machine.path.unlink()
    machine.wrong = 60 * DAY - machine.true
    machine.begin()
    began = machine.age()
    machine.run(20 * DAY)
    machine.wrong = 0
    machine.run(20 * DAY)
    assert abs(machine.age() - began - 40 * DAY) < HOUR


def test_starting_in_the_past_is_ignored(machine: Machine) -> None:
    for _ in range(20):
        machine.off(16 * HOUR)
        machine.wrong = -machine.true
        machine.run(HOUR // 6)
        machine.wrong = 0
        machine.run(8 * HOUR)
    assert abs(machine.age() - machine.true) < DAY


def test_a_long_time_off_counts_after_a_day(machine: Machine) -> None:
    machine.off(90 * DAY)
    assert machine.run(20 * HOUR) < BEGIN + 2 * DAY
    machine.off(2 * HOUR)
    assert abs(machine.run(6 * HOUR) - machine.true) < DAY


def test_data_of_the_first_day_is_as_old_as_it_is(machine: Machine) -> None:
    before = machine.age()
    machine.off(90 * DAY)
    machine.run(8 * HOUR)
    made, date = machine.true, machine.age()
    machine.run(8 * HOUR)
    machine.off(HOUR)
    machine.run(20 * HOUR)
    assert abs(machine.age.true_date(date) - made) < DAY
    assert machine.age.true_date(before - HOUR) == before - HOUR
    machine.off(80 * DAY)
    machine.run(30 * HOUR)
    assert abs(machine.age.true_date(date) - made) < DAY


def test_each_program_that_dates_data_dates_it_by_the_latest() -> None:
    """With the clock alone, data of the first day after a long rest would seem to have rested as well."""
    files = [path for folder in ("appliance", "fleet") for path in (ROOT / folder).rglob("*.py")]
    users = {
        str(path.relative_to(ROOT)): path.read_text() for path in files if "AgeClock(" in path.read_text()
    }
    assert len(users) == 4
    right = (".true_date", ".latest()", "EndTable(")
    assert [name for name, text in users.items() if not any(way in text for way in right)] == []


def test_the_latest_time_has_the_time_off_at_once(machine: Machine) -> None:
    machine.off(90 * DAY)
    machine.run(HOUR)
    assert abs(machine.age.latest() - machine.true) < DAY
    machine.wrong = -YEAR
    machine.off(HOUR)
    assert machine.age.latest() == machine.age()


def test_the_smallest_of_varying_steps_counts(machine: Machine) -> None:
    machine.wrong = YEAR
    machine.off(10 * DAY)
    for wrong in (YEAR, 9 * YEAR, 2 * YEAR, 0):
        machine.wrong = wrong
        machine.run(7 * HOUR)
    assert abs(machine.age() - machine.true) < DAY


def test_it_never_runs_backwards(machine: Machine) -> None:
    last = machine.age()
    for wrong in (-YEAR, 0, -20 * YEAR, 0, HOUR):
        machine.wrong = wrong
        machine.off(HOUR)
        now = machine.run(30 * HOUR)
        assert now >= last + 30 * HOUR
        last = now


@pytest.mark.parametrize("left", [b"", b"{", b'{"lived":"x"}'])
def test_a_damaged_file_starts_from_known_time(tmp_path: Path, left: bytes) -> None:
    path = tmp_path / "age"
    path.write_bytes(left)
    assert abs(AgeClock(path, lambda: BEGIN, wall=lambda: BEGIN + YEAR, monotonic=lambda: 7)() - BEGIN) < HOUR


def test_a_full_disk_does_not_stop_it(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "gone" / "age")
    machine.begin()
    assert machine.run(DAY) == machine.true
