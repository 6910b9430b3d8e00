import itertools
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.search.query import Filter, FilterError
from appliance.audit.search.search import Follower, LogSnapshot, export, search, show
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog

_SECOND = 1_000_000_000
_BEGIN = 1_700_000_000 * _SECOND


@pytest.fixture
def log(make_log: MakeLog) -> AuditLog:
    log = make_log(checkpoint_seconds=3600)
    for number in range(100):
        log.record(decision(log, number, time=_BEGIN + number * _SECOND))
    other = RuleReference("Clients", "/reset/**", "robot.ini", 30)
    odd: list[dict[str, Any]] = [
        {"decision": "deny", "host": "10.66.0.1", "caller_id": "/evil", "resource": "/arm/joint_1"},
        {"decision": "would deny", "resource": "/arm/joint_2", "rule": other, "category": "call"},
        {
            "event": "node lost",
            "decision": None,
            "severity": Severity.ALARM,
            "reason": "No answer from Żółw 100%",
        },
        {"detail": {"type": "std_msgs/Float64", "quote": 'say "hi"'}, "reason": "a_b and a%b", "revision": 9},
        {"host": "fd66::1", "resource": "/six"},
    ]
    for number, fields in enumerate(odd):
        log.record(decision(log, time=_BEGIN + (1000 + number) * _SECOND, **fields))
    assert settle(log) is None
    return log


def sequences(path: Path, wanted: Filter, **arguments: Any) -> list[int]:
    return [entry.sequence - 2 for entry in search(path, wanted, **arguments).entries]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        (Filter(decision=("deny",)), [100]),
        (Filter(decision=("deny", "would deny")), [101, 100]),
        (Filter(host="10.66.0.1"), [100]),
        (Filter(host="10.66.*"), [100]),
        (Filter(hosts=("10.66.0.1/32", "fd00::1/128")), [100]),
        (Filter(hosts=("10.66.0.0/30", "fd00::/8"), decision=("deny",)), [100]),
        (Filter(hosts=("10.66.0.4/30",)), []),
        (Filter(host="10.66.0.0/30"), [100]),
        (Filter(host="::ffff:10.66.0.1"), [100]),
        (Filter(host="::ffff:10.66.0.0/126"), [100]),
        (Filter(host="FD66::1"), [104]),
        (Filter(host="fd66:0::1", decision=("allow",)), [104]),
        (Filter(host="fd66:0::/64"), [104]),
        (Filter(host="10.66.0.1/16"), []),
        (Filter(caller_id="/evil"), [100]),
        (Filter(resource="/arm/*"), [101, 100]),
        (Filter(resource="/arm/joint_?"), [101, 100]),
        (Filter(resource="/arm/joint_[13]"), [100]),
        (Filter(resource="/arm"), []),
        (Filter(category="call"), [101]),
        (Filter(event="node *"), [102]),
        (Filter(severity=Severity.WARNING), [102]),
        (Filter(rule="Clients"), [101]),
        (Filter(rule="/reset/**"), [101]),
        (Filter(since=_BEGIN + 1001 * _SECOND, until=_BEGIN + 1003 * _SECOND), [102, 101]),
        (Filter(until=_BEGIN + 2 * _SECOND), [1, 0]),
        (Filter(text="float64"), [103]),
        (Filter(text="Żółw"), [102]),
        (Filter(text='say \\"hi'), [103]),
        (Filter(text="a_b"), [103]),
        (Filter(text="0%"), [102]),
        (Filter(text="a%b"), [103]),
        (Filter(text="nowhere"), []),
        (Filter(text="arm", decision=("deny",)), [100]),
        (Filter(text="joint", resource="/arm/*", decision=("would deny",)), [101]),
        (Filter(decision=("deny",), category="call"), []),
        (Filter(decision=("allow",), resource="/cmd_7", host="10.0.0.2"), [87, 67, 47, 27, 7]),
    ],
    ids=str,
)
def test_filters(log: AuditLog, path: Path, wanted: Filter, expected: list[int]) -> None:
    assert sequences(path, wanted) == expected
    log.close()
    assert sequences(path, wanted) == expected


def denial(log: AuditLog, host: str, caller: str, topic: str) -> AuditRecord:
    return decision(
        log, decision="deny", host=host, caller_id=caller, resource=topic, rule=None, reason="no rule names it",
        unknown=True,
    )  # fmt: skip


@pytest.mark.parametrize("newest_first", [True, False])
@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        (Filter(resource="/cmd_vel"), 1), (Filter(resource="/cmd_v*"), 1), (Filter(resource="/cmd"), 0),
        (Filter(caller_id="/second"), 1), (Filter(caller_id="/third"), 0),
        (Filter(resource="/cmd_vel", decision=("deny",), host="10.66.0.1"), 1),
        (Filter(resource="/cmd_vel", hosts=("10.66.0.0/16",)), 1),
        (Filter(resource="/cmd_vel", host="10.66.0.2"), 0), (Filter(resource="/cmd_vel", caller_id="/first"), 0),
        (Filter(resource="/cmd_vel", decision=("allow",)), 0), (Filter(resource="/cmd_vel", event="decision"), 0),
        (Filter(resource="/cmd_vel", text="second"), 1), (Filter(resource="/cmd_vel", text="absent"), 0),
    ],
    ids=str,
)  # fmt: skip
def test_a_name_that_was_only_counted_is_found(
    make_log: MakeLog, path: Path, wanted: Filter, expected: int, *, newest_first: bool
) -> None:
    """The kinds of unknown hosts have neither resource nor caller: the second name is only in a summary."""
    log = make_log(checkpoint_seconds=3600)
    log.record(denial(log, "10.66.0.1", "/first", "/a"))
    log.record(denial(log, "10.66.0.1", "/second", "/cmd_vel"))
    assert settle(log) is None
    log.close()
    found = [entry.record for entry in search(path, wanted, newest_first=newest_first).entries]
    assert [record.event for record in found] == ["denials folded"] * expected


def test_names_beyond_the_first_ones_may_be_in_each_summary(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_seconds=3600)
    for number in range(12):
        log.record(denial(log, "10.66.0.1", "/evil", f"/topic{number}"))
    assert settle(log) is None
    log.close()
    (found,) = search(path, Filter(resource="/topic11")).entries
    assert found.record.detail["resources"]["(others)"] == 3
    assert not search(path, Filter(resource="/topic11", caller_id="/good")).entries


@pytest.mark.parametrize("wanted", [Filter(host="10.66.0.1"), Filter(hosts=("10.66.0.0/30",))], ids=str)
def test_a_host_that_is_only_counted_with_others_is_found(
    make_log: MakeLog, path: Path, wanted: Filter
) -> None:
    log = make_log(checkpoint_seconds=3600)
    for number in range(1, 80):
        log.record(denial(log, f"10.77.0.{number}", "/evil", "/a"))
    log.record(denial(log, "10.66.0.1", "/evil", "/a"))
    assert settle(log) is None
    log.close()
    (found,) = search(path, wanted).entries
    assert found.record.detail["scope"] == "unknown hosts"
    assert [entry.sequence for entry in search(path, Filter(host="10.77.0.79")).entries] == [found.sequence]


@pytest.mark.parametrize("newest_first", [True, False])
def test_pages_have_each_summary_once(make_log: MakeLog, path: Path, *, newest_first: bool) -> None:
    log = make_log(checkpoint_seconds=3600)
    for host in range(30):
        for topic in ("/a", "/cmd_vel", "/cmd_vel", "/b"):
            log.record(denial(log, f"10.66.0.{host}", "/evil", topic))
        log.record(decision(log, host="10.66.1.1", resource="/cmd_vel"))
    assert settle(log) is None
    log.close()
    page = search(path, Filter(resource="/cmd_vel"), None, 7, newest_first=newest_first)
    found = [entry.sequence for entry in page.entries]
    while page.cursor is not None:
        page = search(path, Filter(resource="/cmd_vel"), page.cursor, 7, newest_first=newest_first)
        found += [entry.sequence for entry in page.entries]
    assert found == sorted(set(found), reverse=newest_first)
    assert len(found) == 60


def test_a_text_is_found_before_and_after_indexing(log: AuditLog, path: Path) -> None:
    for number in range(600):
        log.record(decision(log, number, reason=f"needle {number}"))
        if number % 100 == 0:
            assert settle(log) is None
            assert len(search(path, Filter(text=f"needle {number}")).entries) >= 1
    assert settle(log) is None
    assert len(search(path, Filter(text="needle"), limit=1000).entries) == 600


@pytest.mark.parametrize("newest_first", [True, False])
@pytest.mark.parametrize("wanted", [Filter(), Filter(resource="/cmd_*"), Filter(text="lets it")])
def test_pages_give_every_record_once(log: AuditLog, path: Path, wanted: Filter, newest_first: bool) -> None:
    everything = [entry.record.id for entry in search(path, wanted, limit=1000).entries]
    found: list[str] = []
    cursor = None
    for _page in itertools.count():
        page = search(path, wanted, cursor, 7, newest_first=newest_first)
        found += [entry.record.id for entry in page.entries]
        cursor = page.cursor
        if cursor is None:
            break
        if newest_first:
            log.record(decision(log))
            assert settle(log) is None
    assert found == (everything if newest_first else everything[::-1])


def test_an_export_has_everything_oldest_first(log: AuditLog, path: Path) -> None:
    entries = list(export(path, Filter(), page=9))
    assert [entry.sequence for entry in entries] == list(range(1, len(entries) + 1))
    assert len(entries) >= 105


def test_a_record_is_shown_with_its_neighbours(log: AuditLog, path: Path) -> None:
    entry = search(path, Filter(resource="/cmd_7", host="10.0.0.2")).entries[2]
    shown = show(path, entry.record.id, neighbours=2)
    assert shown is not None
    assert shown == show(path, str(entry.sequence), neighbours=2)
    assert shown.entry == entry
    assert [one.sequence - entry.sequence for one in shown.before] == [-10, -5]
    assert [one.sequence - entry.sequence for one in shown.after] == [5, 10]
    for unknown in ("0" * 20, "99999999", "", "x' OR 1=1", "\0", "9" * 50, "½"):
        assert show(path, unknown) is None


def test_a_follower_gets_new_records(log: AuditLog, path: Path) -> None:
    follower = Follower(path, Filter(decision=("deny",)))
    assert follower.poll() == []
    sent = [decision(log, number, decision="deny", resource=f"/n{number}") for number in range(25)]
    for one in sent:
        log.record(one)
        log.record(decision(log))
    assert settle(log) is None
    got = [entry.record for _poll in range(10) for entry in follower.poll(limit=10)]
    assert got == sent
    assert follower.poll() == []


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (Filter(resource="x" * 300), "resource: longer than 256"),
        (Filter(resource="*a" * 20), r"resource: more than 8 times '\*'"),
        (Filter(host="\udc80"), "host: not valid Unicode"),
        (Filter(text="y" * 300), "text: longer"),
    ],
)
def test_invalid_filters_are_errors(log: AuditLog, path: Path, wanted: Filter, message: str) -> None:
    with pytest.raises(FilterError, match=message):
        search(path, wanted)


@pytest.mark.parametrize(
    "arguments", [{"limit": 0}, {"limit": 10_001}, {"cursor": "x"}, {"cursor": "-1"}, {"cursor": "9" * 30}]
)
def test_invalid_pages_are_errors(log: AuditLog, path: Path, arguments: dict[str, Any]) -> None:
    with pytest.raises(FilterError):
        search(path, Filter(), **arguments)


def test_a_missing_log_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogUnreadableError, match=r"no audit log yet.*--state"):
        search(tmp_path / "audit.db", Filter())
    with pytest.raises(LogUnreadableError, match=r"is not a state directory \(--state\)"):
        search(tmp_path / "none" / "audit.db", Filter())


def test_a_damaged_log_is_an_error(path: Path) -> None:
    path.write_bytes(b"rubbish" * 1000)
    with pytest.raises(LogUnreadableError, match=r"audit\.db"):
        search(path, Filter())


def test_reading_leaves_no_trace(log: AuditLog, path: Path) -> None:
    log.close()
    before = path.read_bytes()
    search(path, Filter(text="needle"))
    assert path.read_bytes() == before


def test_reads_over_rest_can_be_left_out(log: AuditLog, path: Path) -> None:
    calls = [
        ("GET", "allow", "rest call", "rest"), ("HEAD", "allow", "rest call", "rest"),
        ("POST", "allow", "rest call", "rest"),
        ("GET", "deny", "rest call", "rest"), ('X","method":"GET', "allow", "rest call", "rest"),
        ("GET", "allow", "rest call", "publish"),
    ]  # fmt: skip
    for method, decided, event, category in calls:
        fields: dict[str, Any] = {"event": event, "decision": decided, "category": category}
        log.record(decision(log, resource="/v1/x", detail={"method": method, "status": 200}, **fields))
    assert settle(log) is None
    everything = Filter(resource="/v1/x")
    assert len(sequences(path, everything)) == 6
    shown = search(path, Filter(resource="/v1/x", without_looks=True), newest_first=False).entries
    assert [entry.record.detail["method"] for entry in shown] == ["POST", "GET", 'X","method":"GET', "GET"]
    followed = Follower(path, Filter(resource="/v1/x", without_looks=True), 0).poll(100)
    assert [entry.sequence for entry in followed] == [entry.sequence for entry in shown]


def test_records_are_found_by_token_name(log: AuditLog, path: Path) -> None:
    details: list[dict[str, Any]] = [{"who": "alice"}, {"who": "bob"}, {"text": '"who":"alice"'}, {}]
    for detail in details:
        log.record(decision(log, resource="/v1/x", detail=detail))
    assert settle(log) is None
    assert [len(sequences(path, Filter(who=who))) for who in ("alice", "*", "a*", "eve")] == [1, 2, 1, 0]


@pytest.mark.parametrize(
    "wanted",
    [
        Filter(event="decision"), Filter(host="10.0.0.1"), Filter(host="10.0.0.1", event="decision"),
        Filter(resource="/cmd_1", since=_BEGIN + 30 * _SECOND), Filter(event="node lost"), Filter(text="Float64"),
        Filter(event="decision", text="Float64"), Filter(host="10.66.0.1", decision=("deny",)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("newest_first", [True, False])
def test_a_frequent_name_finds_the_same_records(
    log: AuditLog, monkeypatch: pytest.MonkeyPatch, wanted: Filter, *, newest_first: bool
) -> None:
    """Beyond a number of records of a name, a search walks the name's index in the order of the log."""
    usual = [sequences(log.path, wanted, limit=limit, newest_first=newest_first) for limit in (3, 200)]
    monkeypatch.setattr("appliance.audit.search.search._SELECTIVE", 1)
    assert usual == [
        sequences(log.path, wanted, limit=limit, newest_first=newest_first) for limit in (3, 200)
    ]


def test_a_snapshot_has_the_log_of_its_begin(log: AuditLog) -> None:
    with closing(LogSnapshot(log.path)) as snapshot:
        log.record(decision(log, event="node lost"))
        assert settle(log) is None
        lost = [entry.sequence for entry in snapshot.of_events(("node lost", "log begun"), page=1)]
        assert lost == [1, 104]
        following = snapshot.following("decision", 60)
        assert [next(following).sequence for _ in range(3)] == [61, 62, 63]
    with pytest.raises(LogUnreadableError, match="no audit log yet"):
        LogSnapshot(log.path.with_name("none.db"))
