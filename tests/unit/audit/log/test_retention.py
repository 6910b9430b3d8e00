import itertools
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.retention import Retention, worth_keeping
from appliance.audit.proof.chain_findings import FindingKind
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export, search
from appliance.base import clock
from tests.support.audit import decision, settle
from tests.support.engines import let_pass
from tests.support.virtual_clock import VirtualClock
from tests.unit.audit.conftest import MakeLog, Notary

_DAY = 86_400_000_000_000


def first_sequence(path: Path) -> int:
    return next(export(path, Filter(), page=1)).sequence


def retain(log: AuditLog) -> None:
    let_pass(log, 60)


def make_old(make_log: MakeLog, notary: Notary) -> None:
    notary.ago = 7 * _DAY
    old = itertools.count(clock.wall_ns() - 7 * _DAY, 1000)
    log = make_log(checkpoint_every=100, clock=lambda: next(old))
    for number in range(2000):
        log.record(decision(log, number, time=next(old), reason=f"old {number}"))
        if number % 100 == 99:
            settle(log)
    log.record(decision(log, time=next(old)))
    log.close()
    notary.ago = 0


def test_old_records_are_removed_and_that_is_recorded(make_log: MakeLog, path: Path, notary: Notary) -> None:
    make_old(make_log, notary)
    before = path.stat().st_size
    log = make_log(checkpoint_every=100, retention=Retention(days=1))
    fresh = decision(log, reason="fresh")
    log.record(fresh)
    retain(log)
    assert first_sequence(path) > 1900
    settle(log)
    log.close()
    assert path.stat().st_size < before / 2
    reports = [entry.record for entry in export(path, Filter(event="records removed"))]
    removed = sum(report.detail["count"] for report in reports)
    kept = list(export(path, Filter()))
    assert removed >= 1900
    assert kept[0].sequence == removed + 1
    assert "older than 1" in reports[0].reason
    assert kept[-1].sequence == len(kept) + removed
    assert search(path, Filter(text="fresh")).entries
    assert not search(path, Filter(text="old 17")).entries
    result = verify(path)
    assert result.ok, result.findings
    assert result.removed == removed


def test_removal_by_age_waits_for_receipts(make_log: MakeLog, path: Path, notary: Notary) -> None:
    make_old(make_log, notary)
    received = [700]
    log = make_log(checkpoint_every=100, retention=Retention(days=1, collected=lambda: received[0]))
    log.record(decision(log))
    settle(log)
    retain(log)
    log.housekeeping.remover.due = 0.0
    retain(log)
    assert 400 < first_sequence(path) <= 701
    received[0] = 2100
    log.housekeeping.remover.due = 0.0
    retain(log)
    assert first_sequence(path) > 1900
    log.close()
    assert verify(path).ok


def test_removal_by_size_does_not_wait_for_receipts(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_every=200, retention=Retention(size=2 << 20, collected=lambda: 0))
    for number in range(6000):
        log.record(decision(log, number, reason="x" * 400))
        if number % 200 == 199:
            settle(log)
    retain(log)
    assert first_sequence(path) > 1


def test_young_records_stay(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_every=10, retention=Retention(days=1, size=1 << 30))
    for number in range(500):
        log.record(decision(log, number))
    settle(log)
    log.close()
    assert not search(path, Filter(event="records removed")).entries
    assert search(path, Filter()).entries[-1].sequence


def test_records_with_future_times_delay_no_removal(make_log: MakeLog, path: Path, notary: Notary) -> None:
    now = itertools.count(clock.wall_ns() - 7 * _DAY, 1000)
    notary.ago, ahead = 7 * _DAY, 0
    log = make_log(checkpoint_every=10, clock=lambda: next(now) + ahead)
    for ahead in (0, 365 * _DAY, 0):
        for number in range(100):
            log.record(decision(log, number, time=next(now) + ahead))
            if number % 10 == 9:
                settle(log)
    log.close()
    notary.ago = 0
    log = make_log(checkpoint_every=10, retention=Retention(days=1))
    log.record(decision(log))
    retain(log)
    assert first_sequence(path) > 250
    log.close()
    assert verify(path).ok


def test_waiting_for_the_signers_clock_is_not_an_alarm(make_log: MakeLog, path: Path, notary: Notary) -> None:
    log = make_log(checkpoint_every=10, retention=Retention(days=30))
    for number in range(100):
        log.record(decision(log, number))
        if number % 10 == 9:
            settle(log)
    log.close()
    told: list[bool] = []
    notary.refused = told.append
    log = make_log(
        checkpoint_every=10, retention=Retention(days=30), clock=lambda: clock.wall_ns() + 365 * _DAY
    )
    log.record(decision(log))
    settle(log)
    retain(log)
    assert (told[0], log.degraded) == (True, None)
    assert first_sequence(path) == 1


def test_a_log_past_its_size_loses_its_oldest_records(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_every=200, retention=Retention(size=2 << 20))
    for number in range(12_000):
        log.record(decision(log, number))
        if number % 200 == 0:
            settle(log)
    settle(log)
    retain(log)
    assert first_sequence(path) > 3000
    log.close()
    result = verify(path)
    assert result.ok, result.findings
    assert "larger than" in search(path, Filter(event="records removed")).entries[0].record.reason


def test_denials_and_alarms_are_removed_last(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_every=200, retention=Retention(size=2 << 20))
    early = decision(log, decision="deny", host="10.0.0.66", resource="/cmd_vel", reason="no")
    log.record(early)
    number = 0
    while first_sequence(path) < 3000:
        assert number < 20_000
        for _ in range(200):
            number += 1
            log.record(decision(log, number))
        settle(log)
        let_pass(log, 5)
    settle(log)
    log.close()
    (kept,) = search(path, Filter(decision=("deny",))).entries
    assert (kept.record.id, kept.record.time, kept.record.resource) == (early.id, early.time, "/cmd_vel")
    assert kept.record.detail["kept"]["sequence"] == 2
    assert kept.sequence > 3000
    result = verify(path)
    assert result.ok, result.findings
    assert result.removal == "signed"


def denial(number: int, host: str, **fields: Any) -> AuditRecord:
    return AuditRecord(
        id=f"{number:020x}", time=number, event="decision", decision="deny", host=host, **fields
    )


def test_a_flood_of_denials_leaves_those_of_other_hosts(time: VirtualClock) -> None:
    """At most half of the removed records are copied: alarms, then hosts in turn. Unknown hosts count as one."""
    flood = [denial(number, "10.0.0.66") for number in range(400)]
    unknown = [denial(1000 + n, f"10.9.0.{n}", detail={"unknown_host": True}) for n in range(90)]
    few = [denial(2000 + number, "10.0.0.5") for number in range(10)]
    alarm = denial(3000, "10.0.0.66", severity=Severity.ALARM)
    kept = worth_keeping([*flood, *unknown, *few, alarm], 501)
    assert len(kept) == 250
    assert {one.id for one in few} <= {one.id for one in kept}
    assert alarm in kept
    assert kept == sorted(kept, key=lambda one: one.time)
    assert worth_keeping(few, 1000) == few
    assert worth_keeping(few, 1) == []


@pytest.mark.nightly
def test_unsigned_records_stay(make_log: MakeLog, path: Path) -> None:
    old = itertools.count(clock.wall_ns() - 7 * _DAY, 1000)
    log = make_log(checkpoint_every=100, clock=lambda: next(old), signer=lambda number, text, **_: None)
    for number in range(1000):
        log.record(decision(log, number, time=next(old)))
    settle(log)
    log.close()
    log = make_log(retention=Retention(days=1), signer=lambda number, text, **_: None)
    log.record(decision(log))
    settle(log)
    log.close()
    assert next(export(path, Filter())).sequence == 1


def test_removal_beyond_retention_is_found(make_log: MakeLog, path: Path, notary: Notary) -> None:
    make_old(make_log, notary)
    log = make_log(retention=Retention(days=1))
    log.record(decision(log))
    retain(log)
    assert first_sequence(path) > 1
    log.close()
    first = next(export(path, Filter())).sequence
    with closing(sqlite3.connect(path)) as attacker:
        attacker.execute("DELETE FROM record WHERE sequence <= ?", (first,))
        attacker.commit()
    assert (FindingKind.MISSING, first, first) in {
        (finding.kind, finding.first, finding.last) for finding in verify(path).findings
    }


@pytest.mark.parametrize("wrong", [{"days": 0}, {"days": -1}, {"size": 100}])
def test_invalid_limits_are_rejected(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="retention needs"):
        Retention(**wrong)
