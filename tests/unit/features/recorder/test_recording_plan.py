from itertools import count
from typing import Any

import pytest
from msgspec import structs

from appliance.audit.log.ids import IdSource
from appliance.audit.log.record import Severity
from appliance.base.actors import ROBOT, UNKNOWN
from appliance.features.recorder.recording_answers import OPERATORS, OpenRecording, Trigger, TriggerKind
from appliance.features.recorder.recording_plan import HourlyLimit, RecordingPlan, span
from appliance.features.recorder.settings import RecorderRules
from tests.unit.features.recorder.test_recording_store import SECOND, recording

NOW = 10_000 * SECOND
HOUR = 3600 * SECOND
GUEST = "10.0.0.9"
NAMES = {"127.0.0.1": ROBOT, GUEST: GUEST, "10.0.0.7": "10.0.0.7", "10.0.0.8": "10.0.0.8"}


def made(**rules: object) -> RecordingPlan:
    ids = count(1)
    every: dict[str, Any] = {"enabled": True, "per_hour": 6, "before": 60, "after": 10} | rules
    return RecordingPlan(
        RecorderRules(**every), lambda host: NAMES.get(host, UNKNOWN), lambda: str(next(ids))
    )


def dropped(plan: RecordingPlan, host: str | None, now: int) -> dict[str, str]:
    return plan.detail("message dropped", None, Severity.WARNING, host, now)


def test_each_host_has_its_own_hour_of_each_kind() -> None:
    limit = HourlyLimit(2, [recording(1, "drop", charged_to=GUEST)])
    now = 10 * SECOND

    def take(charged_to: str, what: TriggerKind, now: int = now) -> bool:
        return limit.take(charged_to, what, now)

    assert [take(GUEST, "drop") for _try in range(3)] == [True, False, False]
    assert take(GUEST, "fault")
    assert take(ROBOT, "drop")
    assert take(GUEST, "drop", SECOND + HOUR)
    assert not take(GUEST, "drop", SECOND + HOUR)


def test_a_guests_flood_leaves_the_robot_its_recording() -> None:
    plan = made(longest=80)
    said = [dropped(plan, GUEST, NOW + number * 20 * SECOND) for number in range(100)]
    recordings = {row["recording"] for row in said if "recording" in row}
    assert len(recordings) == 6
    assert all(row.get("recording") or "recorder.per_hour" in row["not_recorded"] for row in said)
    assert "not_recorded" in said[-1]
    robot = dropped(plan, "127.0.0.1", NOW + 2000 * SECOND)
    assert robot["recording"] not in recordings
    assert robot["charged_to"] == ROBOT


def test_unknown_hosts_are_one() -> None:
    plan = made(longest=80)
    said = [dropped(plan, f"10.9.0.{number}", NOW + number * 15 * SECOND) for number in range(200)]
    assert len({row["recording"] for row in said if "recording" in row}) == 6


def test_a_monitor_that_keeps_dropping_prolongs_one_recording() -> None:
    plan = made(longest=3600)
    said = [dropped(plan, GUEST, NOW + number * 30 * SECOND)["recording"] for number in range(30)]
    assert [said.count(name) for name in dict.fromkeys(said)] == [1, 29]


def test_recordings_of_a_host_do_not_overlap() -> None:
    rules = RecorderRules(before=60, after=10, longest=600)
    first = span(rules, NOW, 0)
    assert (first.began, first.ends) == (NOW - 60 * SECOND, NOW + 10 * SECOND)
    later = NOW + 30 * SECOND
    second = span(rules, later, first.ends)
    assert (second.began, second.ends) == (first.ends, later + 60 * SECOND)
    assert second.latest == second.began + 600 * SECOND
    assert span(rules, later, first.ends, 30, 5).ends == later + 5 * SECOND, (
        "an order is carried out as it is"
    )


def test_a_recording_is_prolonged_to_the_maximum() -> None:
    plan = made(longest=100)
    said = [dropped(plan, GUEST, NOW + number * 5 * SECOND) for number in range(21)]
    assert said[0] == said[8] != said[9]
    assert [row["recording"] for row in said].count(said[9]["recording"]) > 9


def test_hosts_together_have_two_open_recordings_and_the_robot_its_own() -> None:
    plan = made()
    assert "recording" in dropped(plan, GUEST, NOW)
    assert "recording" in dropped(plan, "10.0.0.8", NOW)
    assert dropped(plan, "10.0.0.7", NOW) == {"not_recorded": "2 recordings of other hosts are in progress"}
    assert "recording" in dropped(plan, "127.0.0.1", NOW)
    assert "recording" in dropped(plan, None, NOW)


def test_a_record_without_a_recording_has_the_reason() -> None:
    assert "is off" in dropped(made(enabled=False), GUEST, NOW)["not_recorded"]
    plan = made()
    found = dropped(plan, GUEST, NOW)["recording"]
    plan.missed(GUEST, found, "the disk is nearly full", NOW)
    assert dropped(plan, GUEST, NOW + SECOND) == {"not_recorded": "the disk is nearly full"}
    assert "recording" in dropped(plan, GUEST, NOW + 61 * SECOND)
    assert plan.detail("decision", "allow", Severity.INFO, GUEST, NOW) == {}
    assert plan.detail("message changed", None, Severity.NOTICE, GUEST, NOW) == {}


@pytest.mark.parametrize("failed", [*NAMES, None, "10.9.0.1"])
def test_a_failed_recording_hinders_only_its_owner(failed: str | None) -> None:
    ours = {"127.0.0.1", None}
    for other in {*NAMES, None, "10.9.0.2"} - {failed}:
        plan = made()
        planned = dropped(plan, failed, NOW)
        plan.missed(planned["charged_to"], planned["recording"], "recorder.disk is full", NOW)
        said = dropped(plan, other, NOW + 2 * SECOND)
        same = {failed, other} <= ours or ("10.9" in str(failed) and "10.9" in str(other))
        assert ("not_recorded" in said) == same, other
        assert "not_recorded" in dropped(plan, failed, NOW + 59 * SECOND)


def test_a_report_about_a_recording_that_ended_hinders_no_host() -> None:
    """A recording that is too large ends early; triggers until control's notice still have its id."""
    plan = made()
    ended, late = (dropped(plan, "127.0.0.1", NOW + number)["recording"] for number in range(2))
    assert ended == late
    plan.closed(structs.replace(recording(10_000, charged_to=ROBOT), id=ended))
    plan.missed(ROBOT, late, f"recording {late} had ended", NOW + SECOND)
    following = dropped(plan, "127.0.0.1", NOW + 2 * SECOND)["recording"]
    assert following != ended
    plan.missed(ROBOT, late, f"recording {late} had ended", NOW + 3 * SECOND)
    assert dropped(plan, "127.0.0.1", NOW + 4 * SECOND)["recording"] == following


def test_acts_prolong_the_recording_that_is_made_instead() -> None:
    """A new control does not know yet what the recorder is making."""
    plan = made()
    unmade = dropped(plan, "127.0.0.1", NOW)["recording"]
    making = OpenRecording("y", NOW - SECOND, NOW + 10 * SECOND, Trigger(NOW, "order", "r", "t", OPERATORS))
    plan.missed(ROBOT, unmade, "it prolonged recording y", NOW, making)
    assert dropped(plan, None, NOW + SECOND)["recording"] == "y"
    following = dropped(plan, "127.0.0.1", NOW + 30 * SECOND)["recording"]
    assert following not in {"y", unmade}
    plan.missed(ROBOT, unmade, "it prolonged recording y", NOW, making)
    assert dropped(plan, "127.0.0.1", NOW + 31 * SECOND)["recording"] == following


def test_a_clock_that_is_set_back_keeps_no_reason() -> None:
    plan = made()
    later = NOW + 24 * HOUR
    plan.missed(GUEST, dropped(plan, GUEST, later)["recording"], "the disk is nearly full", later)
    assert "recording" in dropped(plan, GUEST, NOW)


def test_recordings_of_an_order_are_prolonged_and_closed_ones_are_not() -> None:
    plan = made()
    plan.opened(ROBOT, "asked", NOW - 60 * SECOND, NOW + 10 * SECOND)
    assert dropped(plan, "127.0.0.1", NOW)["recording"] == "asked"
    plan.opened(OPERATORS, "order", NOW, NOW + 10 * SECOND)
    assert dropped(plan, "127.0.0.1", NOW)["recording"] == "order", (
        "the robot and operators have one together"
    )
    assert dropped(plan, None, NOW)["recording"] == "order"
    closed = structs.replace(recording(10_000, charged_to=ROBOT), id="order")
    plan.stated([closed], [])
    assert dropped(plan, "127.0.0.1", NOW)["recording"] not in {"asked", "order"}
    again = made()  # after a restart of control, the recorder states what it is making
    trigger = Trigger(NOW, "drop", "record", "so", ROBOT)
    again.stated([closed], [OpenRecording("going on", NOW - SECOND, NOW + SECOND, trigger)])
    assert again.end_of("going on") == NOW + SECOND
    assert dropped(again, "127.0.0.1", NOW)["recording"] == "going on"
    assert (again.end_of("going on") or 0) > NOW + SECOND


def test_the_record_of_a_drop_says_which_recording_has_it() -> None:
    rules = RecorderRules(enabled=True, per_hour=1, triggers=["drop", "alarm", "denial"])
    plan = RecordingPlan(rules, lambda host: host, IdSource().next)
    drop = plan.detail("message dropped", None, Severity.WARNING, "10.0.0.9", 1)
    assert (len(drop["recording"]), drop["charged_to"]) == (20, "10.0.0.9")
    assert plan.detail("message changed", None, Severity.INFO, "10.0.0.9", 1) == {}
    assert plan.detail("monitor fault", None, Severity.ALARM, "10.0.0.7", 1)["charged_to"] == "10.0.0.7"
