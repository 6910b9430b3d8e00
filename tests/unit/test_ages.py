"""The age of what runs is right although the system clock is set: a robot without a battery clock starts in 1970."""

import re
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.base.clock import Began
from appliance.channel.answers.status import ProcessInfo
from appliance.control.links.supervisor_link import Surroundings
from tests.support.virtual_clock import VirtualClock

ROOT = Path(__file__).parents[2] / "appliance"
STEPS = [1_795_000_000.0, -40.0]  # a time service corrects 1970, and a clock that was ahead
# These keep a date for more than a run, or an event of the log with its own date.
KEPT = {
    "control/operators/new_state.py",
    "control/operators/switched_off.py",
}


@pytest.mark.parametrize("step", STEPS)
def test_a_beginning_follows_a_step_of_the_clock(step: float) -> None:
    with clock.using(source := VirtualClock(wall=1000.0)):
        began = Began()
        source.advance(60.0)
        assert began.date() == 1000.0
        source.set_wall(1060.0 + step)
        source.advance(5.0)
        assert clock.wall() - began.date() == pytest.approx(65.0)
        before = began.date()
        source.set_wall(clock.wall() + 0.2)
        assert began.date() == before, "a small correction changes no answer"


@pytest.mark.parametrize("step", STEPS)
def test_the_age_of_a_process_survives_a_step_after_its_report(step: float) -> None:
    with clock.using(source := VirtualClock(wall=1000.0)):
        around = Surroundings()
        around.processes = [ProcessInfo("relay", 7, Began().text(), 0)]
        source.advance(60.0)
        source.set_wall(1060.0 + step)
        [row] = around.processes
        assert row.since == Began(clock.wall() - 60.0).text()


def test_no_part_keeps_the_date_of_its_own_beginning() -> None:
    kept = re.compile(
        r"self\._?(since|started|began) = clock\.(wall|utc_now)\(\)|default_factory=(clock\.)?wall\b"
    )
    found = {
        str(file.relative_to(ROOT)) for file in ROOT.rglob("*.py") if kept.search(file.read_text("utf-8"))
    }
    assert found - KEPT == set()
