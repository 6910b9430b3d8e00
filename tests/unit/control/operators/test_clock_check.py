from pathlib import Path

import pytest

from appliance.base import shipped
from appliance.base.clock import using
from appliance.channel.answers.status import ClockState
from appliance.cli.status_verb import doubted_clock
from appliance.control.operators.clock_check import ClockCheck
from tests.support.core import FakeTrail
from tests.support.virtual_clock import VirtualClock


@pytest.fixture
def trail() -> FakeTrail:
    return FakeTrail()


def test_an_unsynchronised_clock_is_recorded_once(trail: FakeTrail) -> None:
    clock = ClockCheck(trail, lambda: 0.0)
    for synchronised in (None, False, False, True, True, None, False):
        clock.synchronisation_reported(synchronised)
        assert clock.state() == ClockState(synchronised, 0.0)
    assert trail.events == ["clock not synchronised", "clock synchronised", "clock not synchronised"]


def test_a_right_clock_is_not_recorded(trail: FakeTrail) -> None:
    clock = ClockCheck(trail, lambda: 0.0)
    clock.synchronisation_reported(True)
    clock.look()
    assert trail.events == []


def test_a_clock_that_was_set_back_is_recorded_once(trail: FakeTrail) -> None:
    behind = [1.5]
    clock = ClockCheck(trail, lambda: behind[0])
    clock.look()
    assert (trail.events, clock.state().behind_seconds) == ([], 0.0)
    for behind[0] in (3600.0, 3590.0, 0.5, 90.0):
        clock.look()
    assert trail.events == ["clock set back"] * 2
    assert clock.state().behind_seconds == 90.0


def test_each_step_forward_is_recorded(trail: FakeTrail) -> None:
    started = [1000.0]
    clock = ClockCheck(trail, lambda: 0.0, lambda: started[0])
    for started[0] in (1000.0, 1001.0, 4600.0, 4600.0, 1000.0, 1003.0):
        clock.look()
    assert trail.events == ["clock set forward"] * 2


@pytest.mark.parametrize(("step", "stepped"), [(0.5, 0), (3600.0, 1), (-3600.0, 1)])
def test_each_step_is_passed_on(trail: FakeTrail, step: float, stepped: int) -> None:
    started, told = [1000.0], list[str]()
    clock = ClockCheck(trail, lambda: 0.0, lambda: started[0], stepped=lambda: told.append("stepped"))
    started[0] += step
    clock.look()
    clock.look()
    assert len(told) == stepped


def test_a_right_that_the_clock_ended_is_recorded(trail: FakeTrail) -> None:
    ClockCheck(trail, lambda: 0.0).cut_short("door ticket", "1f", 3600.0)
    [row] = trail.rows
    assert (row["event"], row["resource"], row["kind"], row["seconds"]) == (
        "ended by the clock",
        "1f",
        "door ticket",
        3600.0,
    )
    assert row["reason"].startswith("door ticket 1f has ended, and the appliance has counted 3600 s less: ")


@pytest.mark.parametrize(
    ("days", "said"), [(0.5, None), (2000.0, "wrong: 2000 days before this program was built")]
)
def test_a_clock_before_the_build_date_is_reported(trail: FakeTrail, days: float, said: str | None) -> None:
    made = Path(shipped.__file__).stat().st_mtime
    clock = ClockCheck(trail, lambda: 0.0)
    clock.synchronisation_reported(True)
    with using(VirtualClock(wall=made - days * 86_400)):
        told = doubted_clock(clock.state())
    assert (told or "").startswith(said or "")
    assert (told is None) is (said is None)
