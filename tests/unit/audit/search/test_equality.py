from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.log.repetition import KIND, new_state, summary
from appliance.audit.search.equality import equal_key, equality_of, group_equal, times


def _drop(reason: str = "limit.drive dropped it: speed 0.4", **fields: Any) -> AuditRecord:
    detail = {"monitor": "limit"} | fields.pop("detail", {})
    event = fields.pop("event", "message dropped")
    shown = {"category": "monitor", "resource": "/cmd_vel", "host": "10.0.0.1", "caller_id": "/teleop"}
    return AuditRecord(id="0" * 20, time=0, event=event, reason=reason, detail=detail, **shown | fields)


def _log(*records: AuditRecord) -> list[LogEntry]:
    return [LogEntry(number, record) for number, record in enumerate(records, 1)]


def _deny(**fields: Any) -> AuditRecord:
    given = {
        "event": "decision",
        "decision": "deny",
        "host": "10.0.0.9",
        "reason": "no rule",
        "resource": "/arm",
    }
    return AuditRecord(id="0" * 20, time=0, **given | fields)


def test_a_flood_is_one_row_with_the_first_record_and_the_last_value() -> None:
    log = _log(
        _drop(),
        _drop("8 more in the same second: limit.drive dropped it: speed 0.41", detail={"count": 8}),
        _drop("limit.drive dropped it: speed 0.45"),
    )
    for entries in (log, log[::-1]):
        [row] = group_equal(entries)
        assert (row.first.sequence, row.last.sequence, row.records, row.count) == (1, 3, 3, 10)
        assert row.value == "limit.drive dropped it: speed 0.45"


def test_a_count_without_a_reason_continues_its_records() -> None:
    log = _log(
        _drop(),
        _drop("8 more in the same second", detail={"count": 8}),
        _drop("limit.drive dropped it: speed 2"),
    )
    for entries in (log, log[::-1]):
        [row] = group_equal(entries)
        assert (row.count, row.value) == (10, "limit.drive dropped it: speed 2")
    first, more, _ = log
    other = LogEntry(9, _drop("limit.arm dropped it"))
    assert [row.count for row in group_equal([more, first, other])] == [9, 1]


@pytest.mark.parametrize(
    "other",
    [
        {"event": "message changed"}, {"decision": "deny"}, {"host": "10.0.0.2"}, {"caller_id": "/joy"},
        {"category": "topic"}, {"resource": "/arm"}, {"severity": Severity.ALARM}, {"detail": {"monitor": "zone"}},
        {"detail": {"category": "violation"}}, {"detail": {"would": "drop"}}, {"reason": "limit.stop dropped it"},
        {"rule": RuleReference("Publishers", "/cmd_vel", "robot.ini", 3)},
    ],
    ids=str,
)  # fmt: skip
def test_records_that_differ_in_more_than_values_are_not_equal(other: dict[str, Any]) -> None:
    assert not equal_key(_drop()).equals(equal_key(_drop(**other)))


def test_actions_for_one_message_do_not_break_the_row() -> None:
    pair = [_drop(), _drop("speed 4", event="monitor log")]
    assert [row.count for row in group_equal(_log(*pair * 5))] == [5, 5]
    assert [row.count for row in group_equal(_log(*pair * 2, _deny(), *pair))] == [2, 2, 1, 1, 1]


def test_decisions_keep_their_order() -> None:
    allow = _deny(decision="allow")
    assert [row.count for row in group_equal(_log(_deny(), _deny(), allow, _deny()))] == [2, 1, 1]


def test_a_summary_of_repetitions_continues_its_record() -> None:
    state = new_state(_deny(), KIND)
    for _ in range(4):
        state.count_in(_deny())
    [row] = group_equal(_log(_deny(), summary(state, "1" * 20, 1)))
    assert (row.count, row.first.record.event, row.value) == (5, "decision", "no rule")
    ended = equality_of(row.last.record)["ended"]
    assert ended == rfc3339(_deny().time) != rfc3339(row.last.record.time), "the count was recorded later"
    many = summary(new_state(_deny(), "host"), "1" * 20, 1)
    assert len(group_equal(_log(_deny(), many))) == 2


def test_a_number_of_records_is_not_a_number_of_repetitions() -> None:
    assert times(AuditRecord(id="0" * 20, time=0, event="records lost", detail={"count": 50})) == 1


_CHOICE = st.sampled_from(
    [
        _drop(),
        _drop("3 more in the same second", detail={"count": 3}),
        _drop("x", event="monitor log"),
        _drop("y 1", resource="/arm"),
        _deny(),
        _deny(decision="allow"),
    ]
)


@given(st.lists(_CHOICE), st.booleans())
def test_no_record_is_lost(records: list[AuditRecord], newest_first: bool) -> None:
    numbers = count(1)
    log = [LogEntry(next(numbers), record) for record in records]
    rows = group_equal(log[::-1] if newest_first else log)
    assert sum(row.records for row in rows) == len(records)
    assert sum(row.count for row in rows) == sum(times(record) for record in records)
