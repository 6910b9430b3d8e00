import json

import msgspec
import pytest

from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.record_format import (
    LogEntry,
    as_json,
    as_object,
    printable,
    rfc3339,
    without_contents,
)

_RECORD = AuditRecord(
    id="0" * 20, time=1_772_366_400_000_000_007, event="decision", severity=Severity.WARNING, decision="deny",
    host="10.0.0.1", caller_id="/n", category="publish", resource="/\x1b]0;x\x07é", revision=3,
    rule=RuleReference("Publishers", "/**", "a.ini", 4), reason="no", duration_us=5,
    detail={"call": "registerPublisher"},
)  # fmt: skip


def test_json_has_the_documented_fields() -> None:
    assert as_object(LogEntry(9, _RECORD)) == {
        "schema": 1, "id": "0" * 20, "time": "2026-03-01T12:00:00.000000007Z", "sequence": 9,
        "event": "decision",
        "severity": "warning", "decision": "deny", "host": "10.0.0.1", "caller_id": "/n",
        "category": "publish",
        "resource": "/\x1b]0;x\x07é",
        "rule": {"section": "Publishers", "key": "/**", "file": "a.ini", "line": 4},
        "revision": 3, "reason": "no", "duration_us": 5, "detail": {"call": "registerPublisher"},
    }  # fmt: skip


def test_no_decision_no_rule() -> None:
    shown = as_object(LogEntry(1, AuditRecord(id="0" * 20, time=0, event="appliance started")))
    assert "decision" not in shown
    assert shown["rule"] is None


def test_json_is_one_line_of_ascii() -> None:
    text = as_json(LogEntry(1, _RECORD))
    assert text.isascii()
    assert text.isprintable()
    assert json.loads(text)["resource"] == _RECORD.resource


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/plain/name_1", "/plain/name_1"),
        ("żółw 机器人", "żółw 机器人"),
        ("\x1b[31mred\x1b[0m", "\\x1b[31mred\\x1b[0m"),
        ("a\r\nb\tc\0", "a\\r\\nb\\tc\\x00"),
        ("\u202eabc\u2066", "\\u202eabc\\u2066"),
        ("\x9b2J", "\\x9b2J"),
        ("\udcff", "\\udcff"),
        ("\\x1b", "\\\\x1b"),
        ("\u2028\ufeff\U000e0041", "\\u2028\\ufeff\\U000e0041"),
    ],
)
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize(
    ("time", "text"),
    [
        (0, "1970-01-01T00:00:00.000000000Z"),
        (-1, "1969-12-31T23:59:59.999999999Z"),
        (2**63 - 1, "2262-04-11T23:47:16.854775807Z"),
    ],
)
def test_time(time: int, text: str) -> None:
    assert rfc3339(time) == text


def test_a_viewer_gets_monitor_records_without_messages() -> None:
    said = {"before": "00", "before_fields": {"data": "x"}, "conditions": {"m.rv:3": {"text": "x"}}}
    dropped = AuditRecord(
        id="0" * 20, time=0, event="message dropped", detail={"monitor": "m", "at": ["m.rv:3"], **said}
    )
    shown = without_contents(LogEntry(1, dropped)).record
    assert shown.detail == {"monitor": "m", "at": ["m.rv:3"], "withheld": list(said)}
    texts = {
        "property 1 of goals (fsm) with id = a: secret, n = 7: twice": "property 1 of goals (fsm): twice",
        "on trial: property 2 of goals (ere) with id = \n: fail": "on trial: property 2 of goals (ere): twice",
        "3 more in the same second: 0 twice with id = a: secret": "3 more in the same second: 0 twice",  # up to 0.1.0
        "3 more in the same second: property 1 of goals (fsm) with id = a: twice": (
            "3 more in the same second: property 1 of goals (fsm): twice"
        ),
        "property 1 of gun (fsm): unsafe": "property 1 of gun (fsm): unsafe",
    }
    for reason, plain in texts.items():
        detail = {"monitor": "goals", "category": "twice", "binding": {"id": "a: secret"}, "handler": reason}
        verdict = AuditRecord(id="0" * 20, time=0, event="monitor verdict", reason=reason, detail=detail)
        shown = without_contents(LogEntry(1, verdict)).record
        assert (shown.reason, shown.detail["handler"]) == (plain, plain)
        assert "secret" not in str(shown)
        shown = without_contents(
            LogEntry(1, msgspec.structs.replace(verdict, detail={"monitor": "goals"}))
        ).record
        assert "secret" not in str(shown)
    ordered = LogEntry(
        2, AuditRecord(id="0" * 20, time=0, event="recording ordered", detail={"before": 60.0, "who": "eve"})
    )
    assert without_contents(ordered) == ordered
