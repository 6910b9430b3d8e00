import math
from typing import Any

import msgspec
import pytest
from rosrv_fleet.index_commands import CollectedLog, _missing, report_of
from rosrv_fleet.search_sql import logs_statement, records_statement

from appliance.audit.log.columns import to_columns
from appliance.audit.log.record import AuditRecord
from appliance.formats.machine_report import MachineReport
from appliance.formats.report_words import page

HOUR = 3_600_000_000_000


def row(place: str, hour: float, event: str, what: str = "", **detail: Any) -> tuple[Any, ...]:
    """Return a row as `records_statement` selects it, of a robot, log and sequence."""
    robot, log, number = place.split()
    sequence = int(number)
    identity = detail.pop("id", f"{robot}{log}{sequence}")
    record = AuditRecord(
        id=identity, time=round(hour * HOUR), event=event, resource=what or None, detail=detail
    )
    *columns, text = to_columns(record, sequence)
    return (robot, log, *columns, bytes(text).decode())


ROWS = [
    row("arm1 a 5", 1, "monitor disabled", "speed", who="ann", earlier="enabled", id="x"),
    row("arm1 a 6", 1.5, "authority handed over", "base", earlier="nobody", holder="10.0.0.5"),
    row(
        "arm1 a 90",
        1,
        "monitor disabled",
        "speed",
        who="ann",
        earlier="enabled",
        id="x",
        kept={"sequence": 5},
    ),
    row("arm1 b 2", 3, "took over", appliance="b", other="a"),
    row("arm1 b 3", 4, "monitor enabled", "speed", who="bob", earlier="disabled"),
    row("arm2 c 1", 2, "log begun"),
    row(
        "arm2 c 7",
        2,
        "monitor set",
        "speed",
        who="ann",
        before={"vMax": 1.5},
        values={"vMax": 0.5},
        id="x",
    ),
]
LOGS = [
    CollectedLog("arm1", "a", 90, HOUR), CollectedLog("arm1", "b", 9, 3 * HOUR), CollectedLog("arm2", "c", 7, 2 * HOUR),
]  # fmt: skip


def made(since: int | None = None, *, waiting: int = 0) -> MachineReport:
    return report_of(LOGS, ROWS, since, 9 * HOUR, waiting=waiting, version="1")


def test_robots_are_merged_by_time_and_a_record_that_was_sent_twice_counts_once() -> None:
    """An id is compared within its robot only, so that a robot cannot hide the records of another one."""
    assert [(intervention.appliance, intervention.event) for intervention in made().interventions] == [
        ("arm1", "monitor disabled"), ("arm1", "authority handed over"), ("arm2", "monitor set"),
        ("arm1", "took over"), ("arm1", "monitor enabled"),
    ]  # fmt: skip


def test_a_robot_and_its_standby_are_one_history() -> None:
    (off,) = made().switched_off
    assert (off.appliance, off.what, off.by, off.ended_by) == ("arm1", "speed", "ann", "bob")
    (driver,) = made().drivers
    assert driver.until_utc == "1970-01-01T03:00:00.000000000Z"  # the takeover


def test_a_state_from_before_the_period_still_counts() -> None:
    report = made(round(3.5 * HOUR))
    assert [intervention.event for intervention in report.interventions] == ["monitor enabled"]
    assert [one.since_utc[11:13] for one in report.switched_off] == ["01"]


@pytest.mark.parametrize(
    ("first", "ends", "heard", "lacks"),
    [
        (1, 8, 9, []), (1, 8, math.inf, []), (1, 8, 7, ["not collected since 07"]),
        (1, 8, 0, ["not collected since 08"]), (1, None, 0, ["not collected since 00"]),
        (5, 8, 9, ["not in the index 02"]), (5, 8, 7, ["not in the index 02", "not collected since 07"]),
        (None, None, 9, ["not in the index 09"]),
    ],
)  # fmt: skip
def test_a_state_that_the_index_may_lack_is_a_gap_of_its_robot(
    first: int | None, ends: int | None, heard: float, lacks: list[str]
) -> None:
    """`first` is None without a log; the report ends at 9 hours."""
    logs = [CollectedLog("arm1", "a", 9, 2 * HOUR, first, ends and ends * HOUR)] if first else []
    found = list(_missing(logs, {"arm1": heard * 3600}, 9 * HOUR))
    assert [f"{gap.event} {gap.time_utc[11:13]}" for gap in found] == lacks
    assert {gap.appliance for gap in found} <= {"arm1"}


def test_the_page_says_which_logs_it_read_and_what_it_cannot_know() -> None:
    text = page(made(waiting=3))
    assert "audit log of arm2" in text and "run `rosrv-fleet verify`" in text
    assert "3 segments are stored, and not in the index yet" in text
    assert text.count("not known to the collector") > 1
    assert msgspec.json.decode(msgspec.json.encode(made()), type=MachineReport) == made()


@pytest.mark.parametrize("robot", [None, "arm1", "arm*", "'; DROP TABLE record; -- %s"])
def test_input_is_never_part_of_a_statement_of_a_report(robot: str | None) -> None:
    for statement in (records_statement(("policy loaded",), robot), logs_statement(robot)):
        assert robot is None or robot not in statement.text
        assert statement.text.count("%s") == len(statement.values)
