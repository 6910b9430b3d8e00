import asyncio
import inspect
import re
from collections.abc import Callable
from pathlib import Path

import pytest

import appliance
from appliance.audit.log.budget import Budget
from appliance.audit.log.events import EVENTS
from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import Severity
from appliance.policy.model import Decision
from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import AUDIT_BYTES
from appliance.telemetry.audit_trail import MAX_REQUESTS, NOT_RECORDED, Asker, AuditTrail
from tests.support.core import MemoryLog

PACKAGE = Path(appliance.__file__).parent
GUEST, UNKNOWN = "10.0.0.66", "10.9.9.9"


FULL = "/var/lib/rosrv/control/audit.db: database or disk is full"


def log_of(failure: str | None = FULL, on_disk: Callable[[], None] = lambda: None) -> MemoryLog:
    """Return a log in memory that charges each record to its host."""
    budget = Budget(lambda host: QuotaClass.UNKNOWN if host == UNKNOWN else QuotaClass.NAMED)
    log = MemoryLog(budget.charge, on_disk)
    log.budget, log.failure = budget, failure
    return log


def trail(log: AuditLog, *, deny: bool) -> AuditTrail:
    return AuditTrail(log, strict=True, deny_when_failed=deny)


def test_errors_do_not_reveal_the_path_of_the_log() -> None:
    """While the log cannot be written, requests are denied, and a node does not learn the cause."""
    audit_trail = trail(log_of(), deny=True)
    assert audit_trail.obstacle == NOT_RECORDED
    assert "/" not in NOT_RECORDED
    assert asyncio.run(audit_trail.durable()) is not None


@pytest.mark.parametrize("failed", [None, "full"])
def test_changes_go_on_without_the_log_where_allowed(failed: str | None) -> None:
    log = log_of(failed)
    assert trail(log, deny=failed is None).obstacle is None
    if failed is not None:
        assert asyncio.run(trail(log, deny=False).durable()) is None


def test_refusals_of_unknown_hosts_are_marked() -> None:
    log = log_of()
    audit_trail = trail(log, deny=True)
    audit_trail.happened("limit exceeded", "too much", decision="deny", host=UNKNOWN)
    audit_trail.happened("limit exceeded", "too much", decision="deny", host=GUEST)
    audit_trail.happened("rest call", "", decision="allow", host=UNKNOWN)
    audit_trail.happened("connection closed", "", host=UNKNOWN)
    assert [record.unknown for record in log.records] == [True, False, False, False]
    assert [record.detail.get("unknown_host", False) for record in log.records] == [True, False, False, False]


def test_an_event_has_the_severity_of_the_registry() -> None:
    log = log_of()
    audit_trail = trail(log, deny=True)
    audit_trail.happened("tunnel refused", "no certificate")
    audit_trail.happened("limit exceeded", "no room", severity=Severity.ALARM)
    audit_trail.happened("reconciled", "")
    assert [record.severity for record in log.records] == [Severity.WARNING, Severity.ALARM, Severity.INFO]


def test_events_of_a_host_beyond_its_quota_are_counted() -> None:
    log = log_of()
    audit_trail = trail(log, deny=True)
    audit_trail.happened("connection opened", "", host=GUEST)
    audit_trail.happened("malformed", "x" * AUDIT_BYTES.bounds.host, host=GUEST)
    audit_trail.happened("connection opened", "", host=GUEST)
    audit_trail.happened("limit exceeded", "", host=GUEST, decision="deny")
    audit_trail.happened("connection opened", "", host="10.0.0.1")
    audit_trail.happened("host blocked", "", host=GUEST, whole=True)
    assert [record.folds for record in log.records] == [False, False, True, False, False, False]
    assert GUEST in audit_trail.owing(GUEST)


def test_details_of_features_are_added_to_a_record() -> None:
    log = log_of()
    audit_trail = trail(log, deny=False)
    audit_trail.add_details(lambda event, *_: {"kept": f"in {event}"})
    for severity in (Severity.NOTICE, Severity.INFO):
        audit_trail.happened(
            "message dropped", "too fast", severity=severity, host="10.0.0.9", more={"kept": "forged"}
        )
    audit_trail.happened("malformed", "no XML", decision="deny", host="10.0.0.9")
    assert [record.detail["kept"] for record in log.records] == [
        "in message dropped",
        "forged",
        "in malformed",
    ]


def test_records_that_the_log_has_yet_to_count_are_not_owed() -> None:
    def correct() -> None:
        for record in log.records:
            log.budget.correct(record, -1)
        log.records.clear()

    log = log_of(None, correct)
    audit_trail = trail(log, deny=True)
    while not audit_trail.owing(GUEST):
        audit_trail.happened("malformed", "x" * 100_000, decision="deny", host=GUEST)
    assert asyncio.run(audit_trail.still_owing(GUEST)) == ""


def test_records_that_are_written_are_owed() -> None:
    log = log_of()
    audit_trail = trail(log, deny=True)
    while not audit_trail.owing(GUEST):
        audit_trail.happened("malformed", "x" * 100_000, decision="deny", host=GUEST)
    assert "bytes of audit records" in asyncio.run(audit_trail.still_owing(GUEST))


@pytest.mark.parametrize("event", [*EVENTS, "decision"])
@pytest.mark.parametrize("host", [None, GUEST, UNKNOWN, "not an address"])
def test_each_record_of_a_denial_is_counted_and_no_other(event: str, host: str | None) -> None:
    """A record of several denials, such as a relay's, counts all of them. The end of a right denies none."""
    log = log_of()
    audit_trail = trail(log, deny=True)
    refuses = event != "revoked"
    for number, decision in enumerate((None, "allow", "would deny", "ask", "deny"), 1):
        before = audit_trail.meter.denied.counts()
        audit_trail.happened(event, "why", decision=decision, host=host, resource="/t", count=number)
        assert (audit_trail.meter.denied.counts() != before) == (refuses and decision == "deny")
    denied = {key: count for key, count in audit_trail.meter.decisions.items() if key[1] == "deny"}
    assert denied == {("other", "deny"): 5}
    assert audit_trail.meter.denied_hosts.counts() == {"" if host in {None, UNKNOWN} else host: 5}
    most = f"{host or 'a caller without an address'} was denied other /t, 5 times"
    assert audit_trail.meter.most_denied() == (most if refuses else "")


@pytest.mark.parametrize("held", [False, True])
def test_a_call_that_waits_for_an_approval_is_not_a_denial(*, held: bool) -> None:
    log = log_of()
    audit_trail = trail(log, deny=True)
    audit_trail.decided(Asker(GUEST, "/n", 0), "c", "call", "/home", Decision(False, None, "why", held=held))
    word = "ask" if held else "deny"
    assert log.records[0].decision == word
    assert audit_trail.meter.decisions == {("call", word): 1}
    assert audit_trail.meter.denied.counts() == ({} if held else {"call": 1})


def test_a_flood_of_requests_holds_few_names() -> None:
    one = trail(log_of(), deny=True)
    for number in range(10 * MAX_REQUESTS):
        one.happened(
            "decision", "why", decision="deny", host=UNKNOWN, category="publish", resource=f"/{number}"
        )
    assert (
        len(one.meter.denied_requests.counts()) <= 2 * MAX_REQUESTS
    )  # of two seconds, if the second changed
    assert sum(one.meter.denied.counts().values()) == 10 * MAX_REQUESTS
    assert re.match(f"{UNKNOWN} was denied publish /0 and more, [0-9]+ times$", one.meter.most_denied())


def test_only_the_trail_makes_records_with_a_decision() -> None:
    """So no denial is recorded without being counted. The audit log itself makes summaries, and copies of records."""
    made = {
        str(file.relative_to(PACKAGE))
        for file in PACKAGE.rglob("*.py")
        if re.search(r"\bAuditRecord\(", file.read_text(encoding="utf-8"))
    }
    assert {name for name in made if not name.startswith("audit/log/")} == {"telemetry/audit_trail.py"}
    own = inspect.getsource(AuditTrail)
    assert own.count("self.audit.record(") == 1, "every record passes the one method that counts it"
    assert "self.meter.count_record(record)\n        return self.audit.record(record)" in own
