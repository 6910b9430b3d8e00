import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.record_format import LogEntry
from appliance.audit.proof.copies import SYSLOG_ELEMENT, SignedCheckpoint
from appliance.features.syslog.syslog import ELEMENT, Formatter
from tests.support.syslog import parse

_TIME = 1_700_000_000_123_456_789


def entry(**fields: Any) -> LogEntry:
    all_fields: dict[str, Any] = {"id": "0" * 20, "time": _TIME, "event": "decision"} | fields
    return LogEntry(7, AuditRecord(**all_fields))


def formatter(longest: int = 8192) -> Formatter:
    return Formatter(facility=13, longest=longest, host_name="robot-1")


def test_a_denial_has_all_its_parameters() -> None:
    message = parse(
        formatter().record(
            entry(
                severity=Severity.WARNING, decision="deny", host="10.0.0.66", caller_id="/evil",
                category="publish", resource="/cmd_vel", revision=3, reason="[Publishers] /cmd_vel does not have it",
                rule=RuleReference("Publishers", "/cmd_vel", "robot.ini", 12), detail={"call": "registerPublisher"},
            )
        )
    )  # fmt: skip
    assert (message.facility, message.severity) == (13, 4)
    assert (message.host, message.program, message.event) == ("robot-1", "rosrv", "decision")
    assert message.time == "2023-11-14T22:13:20.123456Z"
    assert message.text == "[Publishers] /cmd_vel does not have it"
    assert message.elements == {
        ELEMENT: {
            "sequence": "7", "id": "0" * 20, "event": "decision", "severity": "warning", "decision": "deny",
            "host": "10.0.0.66", "caller_id": "/evil", "category": "publish", "resource": "/cmd_vel",
            "rule": "[Publishers] /cmd_vel robot.ini:12", "revision": "3",
            "detail": '{"call":"registerPublisher"}',
        }
    }  # fmt: skip


@pytest.mark.parametrize(
    ("severity", "number"),
    [
        (Severity.DEBUG, 7),
        (Severity.INFO, 6),
        (Severity.NOTICE, 5),
        (Severity.WARNING, 4),
        (Severity.ALARM, 1),
    ],
)
def test_severities_are_mapped(severity: Severity, number: int) -> None:
    assert parse(formatter().record(entry(severity=severity))).severity == number


def test_the_event_is_the_message_id() -> None:
    assert parse(formatter().record(entry(event="denials folded"))).event == "denials-folded"


@given(
    caller=st.text(max_size=80), resource=st.text(max_size=80), reason=st.text(max_size=200),
    detail=st.dictionaries(st.text(max_size=8), st.text(max_size=30), max_size=4),
)  # fmt: skip
def test_names_of_unknown_hosts_are_escaped(
    caller: str, resource: str, reason: str, detail: dict[str, str]
) -> None:
    record = entry(caller_id=caller, resource=resource, reason=reason, detail=detail)
    data = formatter().record(record)
    assert all(0x20 <= one <= 0x7E for one in data)
    fields = parse(data).fields
    assert set(fields) <= {"sequence", "id", "event", "severity", "caller_id", "resource", "detail"}
    if detail:
        assert json.loads(fields["detail"].encode().decode("unicode_escape")) is not None


def test_a_name_cannot_inject_fields() -> None:
    evil = '/x"] [rosrv@32473 decision="allow"]\n<0>1 - - - - - -'
    message = parse(formatter().record(entry(caller_id=evil, decision="deny")))
    assert message.fields["decision"] == "deny"
    assert message.fields["caller_id"] == '/x"] [rosrv@32473 decision="allow"]\\n<0>1 - - - - - -'
    assert list(message.elements) == [ELEMENT]


@pytest.mark.parametrize("longest", [2048, 8192])
def test_a_message_is_bounded(longest: int) -> None:
    huge = "\\]" * 4096
    data = formatter(longest).record(
        entry(
            caller_id=huge,
            resource=huge[:300],
            host="10.0.0.1",
            reason="r" * 4096,
            detail={"x": "y" * 60_000},
        )
    )
    assert len(data) <= longest
    message = parse(data)
    assert message.fields["cut"] == "detail"
    assert message.fields["sequence"] == "7"
    assert message.fields["caller_id"].endswith("...")
    assert message.text.startswith("rrr")


def test_a_message_fits_a_datagram() -> None:
    data = formatter(2048).record(entry(reason="why it was so", detail={"before": "00" * 4000}))
    assert len(data) <= 2048
    assert parse(data).text == "why it was so"


@pytest.mark.parametrize("time", [-1, 0, 2**62, -(2**62)])
def test_any_time_is_valid(time: int) -> None:
    parse(formatter().record(entry(time=time)))


@pytest.mark.parametrize("name", ["", "räuber", "two words", "x" * 300, "\n"])
def test_any_host_name_is_valid(name: str) -> None:
    assert parse(Formatter(facility=0, longest=2048, host_name=name).record(entry())).host


def test_a_checkpoint_has_its_signature() -> None:
    checkpoint = SignedCheckpoint("a" * 32, 3, 120, "b" * 64, _TIME, "c" * 64, "d" * 128, "e" * 64)
    message = parse(formatter().checkpoint(checkpoint))
    assert message.event == "checkpoint-signed"
    assert message.elements == {
        SYSLOG_ELEMENT: {
            "log": "a" * 32, "number": "3", "sequence": "120", "hash": "b" * 64, "time": str(_TIME),
            "previous": "c" * 64, "signature": "d" * 128, "key": "e" * 64,
        }
    }  # fmt: skip
