"""Tests of what control says of the machine's clock: once, and it blocks nothing."""

import time
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.base import shipped
from appliance.channel.answers.status import ClockState
from appliance.cli.status_view import doubted_clock
from appliance.control.clock_check import Clock
from appliance.telemetry.audit_trail import AuditTrail


class Trail:
    """What is recorded."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def happened(self, event: str, _text: str, **_more: Any) -> None:
        """As the trail takes it."""
        self.events.append(event)


@pytest.fixture
def trail() -> Trail:
    """A log."""
    return Trail()


def test_a_clock_that_nobody_keeps_is_recorded_once(trail: Trail) -> None:
    """It is said when it is so, and when it is over; what is not known is no news."""
    clock = Clock(cast(AuditTrail, trail), lambda: 0.0)
    for synchronised in (None, False, False, True, True, None, False):
        clock.told(synchronised)
        assert clock.state() == ClockState(synchronised, 0.0)
    assert trail.events == ["clock not synchronised", "clock synchronised", "clock not synchronised"]


def test_a_clock_that_is_right_is_not_recorded(trail: Trail) -> None:
    """At a start where all is well nothing is said."""
    clock = Clock(cast(AuditTrail, trail), lambda: 0.0)
    clock.told(True)
    clock.look()
    assert trail.events == []


def test_a_clock_that_was_set_back_is_recorded_once(trail: Trail) -> None:
    """Each time it is set back there is one record, however often it is looked at; a second is no step."""
    behind = [1.5]
    clock = Clock(cast(AuditTrail, trail), lambda: behind[0])
    clock.look()
    assert (trail.events, clock.state().behind_seconds) == ([], 0.0)
    for behind[0] in (3600.0, 3590.0, 0.5, 90.0):
        clock.look()
    assert trail.events == ["clock set back"] * 2
    assert clock.state().behind_seconds == 90.0


def test_each_step_forward_is_recorded(trail: Trail) -> None:
    """Between two records more time seems to have passed than has: who reads them is told; a second is no step."""
    started = [1000.0]
    clock = Clock(cast(AuditTrail, trail), lambda: 0.0, lambda: started[0])
    for started[0] in (1000.0, 1001.0, 4600.0, 4600.0, 1000.0, 1003.0):
        clock.look()
    assert trail.events == ["clock set forward"] * 2


@pytest.mark.parametrize(
    ("days", "said"), [(0.5, None), (2000.0, "wrong: it stands 2000 days before this program")]
)
def test_a_clock_that_stands_before_the_program_was_made_is_told(
    trail: Trail, monkeypatch: pytest.MonkeyPatch, days: float, said: str | None
) -> None:
    """A machine that has not asked for the time yet: there is no record that it could be held against."""
    made = Path(shipped.__file__).stat().st_mtime
    clock = Clock(cast(AuditTrail, trail), lambda: 0.0)
    clock.told(True)
    monkeypatch.setattr(time, "time", lambda: made - days * 86_400)
    told = doubted_clock(clock.state())
    assert (told or "").startswith(said or "")
    assert (told is None) is (said is None)
