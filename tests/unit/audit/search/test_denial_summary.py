import time

import msgspec
import pytest

from appliance.audit.log.columns import StoredColumns, to_columns
from appliance.audit.log.log_database import open_for_writing
from appliance.audit.log.record import AuditRecord, RuleReference
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.log.repetition import ALL, ALL_UNKNOWN, HOST, KIND, OTHERS, UNKNOWN
from appliance.audit.search import denial_summary
from appliance.audit.search.denial_summary import CountedName, DenialSummary, summarise, summary_of_log
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.base import clock
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, key, make_log, notary, path

__all__ = ["key", "make_log", "notary", "path"]

RULE = RuleReference("Publishers", "/cmd_*", "robot.ini", 12)
BEGIN = 1_800_000_000_000_000_000
_SECOND = 1_000_000_000


def denial(
    second: int, host: str | None = "10.0.0.1", reason: str = "no rule", **changes: object
) -> AuditRecord:
    at = BEGIN + second * _SECOND
    fields = {"id": f"{second:020x}", "event": "decision", "decision": "deny", "caller_id": "/a"} | changes
    return AuditRecord(time=at, host=host, reason=reason, **fields)  # type: ignore[arg-type]  # as the caller says


def folded(scope: str, host: str | None, count: int, **more: object) -> AuditRecord:
    detail = {
        "scope": scope,
        "count": count,
        "first_time": BEGIN + 10 * _SECOND,
        "last_time": BEGIN + 20 * _SECOND,
    }
    caller = "/a" if scope == KIND else None
    return denial(
        30, host, f"{count} further denials of many kinds", event="denials folded", caller_id=caller,
        detail=detail | more,
    )  # fmt: skip


def of(*records: AuditRecord, limit: int = 10) -> DenialSummary:
    return summarise([LogEntry(place, record) for place, record in enumerate(records)][::-1], limit)


def test_the_host_with_the_most_denials_is_first() -> None:
    summary = of(
        denial(1), denial(2, "10.0.0.2", rule=RULE), denial(3, "10.0.0.2", rule=RULE, caller_id="/b"),
        denial(4, "10.0.0.2", "value 7 is wrong"), denial(5, "10.0.0.2", "value 8 is wrong"),
        denial(6, "10.0.0.2", "third"), denial(7, "10.0.0.2", "third"), denial(8, "10.0.0.2", "fourth"),
    )  # fmt: skip
    assert summary.denials == 8
    second, first = summary.hosts
    assert (second.host, second.count, first.host, first.count) == ("10.0.0.2", 7, "10.0.0.1", 1)
    assert (second.first, second.last) == (rfc3339(BEGIN + 2 * _SECOND), rfc3339(BEGIN + 8 * _SECOND))
    assert {(reason.name, reason.count) for reason in second.reasons} == {
        ("[Publishers] /cmd_* robot.ini:12", 2), ("value 8 is wrong", 2), ("third", 2),
    }  # fmt: skip
    assert second.callers == [CountedName("/a", 6), CountedName("/b", 1)]


def test_decisions_come_before_the_noise_of_a_port_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(denial_summary, "_MAX_NAMES", 8)
    noise = [
        denial(at, reason=f"{word} is not HTTP", event="malformed")
        for word in "abcdefghijkl"
        for at in range(9)
    ]
    folded_noise = folded(KIND, "10.0.0.1", 99, of="malformed", reasons={"x is not HTTP": 99})
    calls = folded(KIND, "10.0.0.1", 3, of="decision", reasons={"no rule for /arm": 3})
    [row] = of(denial(1, rule=RULE), calls, *noise, folded_noise).hosts
    assert [(reason.name, reason.count) for reason in row.reasons] == [
        ("no rule for /arm", 3),
        ("[Publishers] /cmd_* robot.ini:12", 1),
        ("x is not HTTP", 99),
    ]
    assert row.more_reasons == 8


def test_revoked_rights_are_not_counted() -> None:
    revoked = msgspec.structs.replace(denial(1), event="revoked")
    counted = msgspec.structs.replace(folded(KIND, "10.0.0.1", 5), detail={"of": "revoked", "count": 5})
    assert of(revoked, counted).hosts == []
    assert of(denial(1), revoked, counted).denials == 1


def test_counted_repetitions_count_as_their_number() -> None:
    summary = of(
        folded(KIND, "10.0.0.1", 5, reasons={"no rule": 5}),
        folded(HOST, "10.0.0.2", 7, reasons={"busy 3": 4, "busy 4": 2, OTHERS: 1}, callers={"/x": 3, "/y": 4}),
        folded(UNKNOWN, "10.0.0.3", 2, reasons={"no rule": 2}),
    )  # fmt: skip
    assert [(row.host, row.count) for row in summary.hosts] == [
        ("10.0.0.2", 7),
        ("10.0.0.1", 5),
        ("10.0.0.3", 2),
    ]
    assert {(row.first, row.last) for row in summary.hosts} == {
        (rfc3339(BEGIN + 10 * _SECOND), rfc3339(BEGIN + 20 * _SECOND))
    }
    assert summary.hosts[0].reasons == [CountedName("busy 3", 6), CountedName(OTHERS, 1)]
    assert summary.hosts[0].callers == [CountedName("/y", 4), CountedName("/x", 3)]


@pytest.mark.parametrize("scope", [ALL, ALL_UNKNOWN])
def test_repetitions_of_many_hosts_count_for_the_hosts_that_are_named(scope: str) -> None:
    summary = of(denial(1), folded(scope, None, 100, hosts={"10.0.0.1": 60, "10.0.0.9": 10, OTHERS: 20}))
    assert summary.denials == 101
    assert [(row.host, row.count) for row in summary.hosts] == [
        ("10.0.0.1", 61),
        (OTHERS, 30),
        ("10.0.0.9", 10),
    ]
    damaged = of(folded(scope, None, 5, hosts={"10.0.0.1": 60, "10.0.0.2": "x", "10.0.0.3": -1}))
    assert [(row.host, row.count) for row in damaged.hosts] == [(OTHERS, 5)]


def test_a_denial_without_a_host_is_listed() -> None:
    assert [(row.host, row.count) for row in of(denial(1, None)).hosts] == [("(no host)", 1)]


def test_everything_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, most in (("_MAX_HOSTS", 5), ("_MAX_NAMES", 3), ("MAX_RECORDS", 40)):
        monkeypatch.setattr(denial_summary, name, most)
    many = [denial(second, f"10.0.0.{second % 8}") for second in range(40)]
    found = of(*many, limit=2)
    assert (found.denials, len(found.hosts), found.more_hosts, found.counted_since) == (40, 2, 4, None)
    assert (found.hosts[0].host, found.hosts[0].count) == (OTHERS, 15)
    assert found.hosts[0].count + found.hosts[1].count + found.more_denials == 40
    [own] = of(*(denial(number, reason=f"x{number}", caller_id=f"/{number}") for number in range(9))).hosts
    assert (own.reasons[0], len(own.callers)) == (CountedName(OTHERS, 6), 4)
    cut = of(*many, *many)
    assert (cut.denials, cut.counted_since) == (40, rfc3339(BEGIN))


def test_no_reason_has_contents_of_messages() -> None:
    said = denial(1, reason="m: 3 alarm with frame = secret", detail={"monitor": "m"})
    assert "secret" not in msgspec.json.encode(of(said)).decode()


def test_the_summary_counts_the_denials_of_a_search(make_log: MakeLog) -> None:
    log = make_log()
    for _ in range(30):
        log.record(decision(log, decision="deny", host="10.0.0.1", caller_id="/flood", resource="/x"))
    log.record(decision(log, host="10.0.0.2"))
    log.record(decision(log, decision="would deny", host="10.0.0.3"))
    settle(log)
    assert log.close() is None  # writes the summary of the repetitions
    summary = summary_of_log(log.path, Filter(), 10)
    assert [(row.host, row.count) for row in summary.hosts] == [("10.0.0.1", 30)]
    assert len([*export(log.path, Filter(decision=("deny",)))]) < 30
    assert summary_of_log(log.path, Filter(since=clock.wall_ns() + 60 * _SECOND), 10).hosts == []


@pytest.mark.nightly
def test_ten_thousand_denials_take_less_than_half_a_second(make_log: MakeLog) -> None:
    log = make_log()
    assert log.close() is None
    connection = open_for_writing(log.path)
    marks = ", ".join("?" * (len(StoredColumns._fields) + 1))
    connection.execute("BEGIN")
    connection.executemany(
        f"INSERT INTO record ({', '.join(StoredColumns._fields)}, hash) VALUES ({marks})",  # noqa: S608  fixed names
        (
            (*to_columns(denial(number, f"10.0.{number % 1000 // 250}.{number % 250}"), number + 10), b"")
            for number in range(10_000)
        ),
    )
    connection.execute("COMMIT")
    connection.close()
    took = []
    for _ in range(3):  # the minimum, because other processes may disturb the caches
        before = time.process_time()
        summary = summary_of_log(log.path, Filter(), 20)
        took.append(time.process_time() - before)
    assert min(took) < 0.4
    assert (summary.denials, summary.more_hosts) == (10_000, 980)
