import itertools
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from appliance.audit.log.columns import LARGEST_DETAIL
from appliance.audit.log.folding import FoldSettings, RecordFolder
from appliance.audit.log.record import AuditRecord, RuleReference
from appliance.audit.log.repetition import HOST, UNKNOWN, FoldState, new_state, summary
from appliance.quotas.pool import Bounds

_numbers = itertools.count(1)


def make_folder(
    seconds: float = 10.0, keys: int = 4096, keys_per_host: int = 256, unknown: int = 8
) -> RecordFolder:
    ids = itertools.count(1)
    bounds = Bounds(keys, min(keys_per_host, keys), min(unknown, keys), 0)
    settings = FoldSettings(seconds=seconds, kinds=bounds, read_kinds=bounds)
    return RecordFolder(settings, lambda: f"s{next(ids)}", lambda: 1)


def denial(resource: str = "/a", host: str = "10.0.0.1", **fields: Any) -> AuditRecord:
    plain: dict[str, Any] = {
        "event": "decision", "decision": "deny", "caller_id": "/n", "category": "call", "reason": "no",
    }  # fmt: skip
    return AuditRecord(id=f"r{next(_numbers)}", time=1, host=host, resource=resource, **(plain | fields))


def offer(folder: RecordFolder, *records: AuditRecord, now: float = 0) -> list[AuditRecord]:
    return [written for record in records for written in folder.offer(record, now)]


def test_first_in_full_then_counted() -> None:
    folder = make_folder(seconds=10)
    same = [denial() for _ in range(100)]
    assert offer(folder, *same) == same[:1]
    assert list(folder.expire(9.9)) == []
    (summary,) = folder.expire(10)
    assert summary.event == "denials folded"
    assert summary.decision == "deny"
    assert (summary.host, summary.caller_id, summary.resource) == ("10.0.0.1", "/n", "/a")
    assert summary.detail["count"] == 99
    assert summary.detail["recorded_id"] == same[0].id
    assert (summary.detail["first_id"], summary.detail["last_id"]) == (same[1].id, same[99].id)


def test_a_call_that_waits_for_an_approval_is_one_record_whatever_time_is_left() -> None:
    folder = make_folder(seconds=10)
    same = [
        denial(decision="ask", reason=f"held for approval 7; expires in {left} s") for left in (120, 119, 118)
    ]
    assert [folder.in_full(one) for one in same] == [same[0].id] * 3
    assert offer(folder, *same) == same[:1]
    (summary,) = folder.expire(10)
    assert (summary.event, summary.decision, summary.detail["count"]) == ("repetitions folded", "ask", 2)


def test_summaries_continue_with_the_repetitions() -> None:
    folder = make_folder(seconds=10)
    offer(folder, denial(), denial(), now=0)
    assert [one.detail["count"] for one in folder.expire(10)] == [1]
    assert offer(folder, denial(), denial(), now=11) == []
    assert [one.detail["count"] for one in folder.expire(20)] == [2]
    assert list(folder.expire(30)) == []
    assert len(folder) == 0
    again = denial()
    assert offer(folder, again, now=31) == [again]


class Interrupted(dict[Any, Any]):
    def __init__(self, here: dict[Any, Any], others_work: Callable[[], object]) -> None:
        super().__init__(here)
        self._others_work = others_work

    def get(self, key: Any, default: Any = None) -> Any:
        found = super().get(key, default)
        self._others_work()
        return found


@pytest.mark.parametrize("attribute", ["_kinds", "_coming"])
def test_a_repetition_gets_the_id_of_a_record_that_is_just_written(
    monkeypatch: pytest.MonkeyPatch, attribute: str
) -> None:
    folder = make_folder()
    first, second = denial(), denial()
    assert folder.in_full(first) == first.id
    written: list[AuditRecord] = []
    left = iter([first])

    def write() -> None:
        written.extend(offer(folder, *left))

    monkeypatch.setattr(folder, attribute, Interrupted(getattr(folder, attribute), write))
    told = folder.in_full(second)
    written += offer(folder, *left, second)
    assert told in {one.id for one in written}


def test_the_reason_of_a_summary_counts_in_english() -> None:
    reasons = []
    for folds in (False, True):
        state = new_state(denial(folds=folds), HOST)
        for _ in range(2):
            state.count_in(denial())
            reasons.append(summary(state, "s", 1).reason)
    assert reasons == [
        "1 further denial of many kinds",
        "2 further denials of many kinds",
        "1 further record of a host beyond its quota",
        "2 further records of a host beyond its quota",
    ]
    state = new_state(denial(), UNKNOWN)
    for _ in range(900):
        state.count_in(denial())
    assert summary(state, "s", 1).reason == "10.0.0.1 was denied call /a, 900 times"


def test_a_summary_has_no_author_if_none_is_known() -> None:
    folder = make_folder(seconds=10)
    calls = [denial(detail={"who": None, "method": "GET", "status": 401}) for _ in range(2)]
    offer(folder, *calls, now=0)
    [summary] = folder.expire(10)
    assert "who" not in summary.detail
    assert summary.detail["method"] == "GET"


def test_different_records_are_not_folded() -> None:
    folder = make_folder()
    kinds = [
        denial(), denial(reason="other"), denial(host="10.0.0.2"), denial(caller_id="/other"), denial("/b"),
        denial(rule=RuleReference("Publishers", "/**", "robot.ini", 3)),
        denial(revision=9), denial(category="read"), denial(decision="would deny"),
    ]  # fmt: skip
    assert offer(folder, *kinds) == kinds


def test_an_allow_ends_the_folding_it_contradicts() -> None:
    folder = make_folder()
    offer(folder, denial(), denial())
    allowed = denial(decision="allow")
    written = offer(folder, allowed)
    assert [one.event for one in written] == ["denials folded", "decision"]
    assert written[1] is allowed
    again = denial()
    assert offer(folder, again) == [again]


def test_an_allow_ends_every_folding_of_its_request() -> None:
    folder = make_folder()
    offer(folder, *(denial(reason=reason) for reason in ("no", "never") for _ in range(2)))
    *summaries, _allow = offer(folder, denial(decision="allow"))
    assert ([one.detail["count"] for one in summaries], len(folder)) == ([1, 1], 0)


def test_allows_that_change_something_are_never_folded() -> None:
    folder = make_folder()
    allows = [denial(decision="allow") for _ in range(50)]
    assert offer(folder, *allows) == allows


def test_varied_names_are_folded_per_host() -> None:
    folder = make_folder(keys_per_host=16, keys=64)
    flood = offer(folder, *(denial(f"/{number}") for number in range(10_000)))
    assert len(flood) == 17
    assert len(folder) == 17
    victim = denial(host="10.0.0.9")
    assert offer(folder, victim) == [victim]
    summaries = list(folder.finish())
    assert sum(one.detail["count"] for one in summaries) == 10_000 - 17
    (host,) = [one for one in summaries if one.detail["scope"] == "host"]
    assert host.host == "10.0.0.1"
    assert host.resource is None
    resources = host.detail["resources"]
    assert len(resources) == 9
    assert resources["(others)"] > 1
    assert sum(resources.values()) == host.detail["count"]


def test_varied_addresses_are_folded_together() -> None:
    folder = make_folder(keys=64)
    written = offer(folder, *(denial(host=f"10.1.{n // 256}.{n % 256}") for n in range(20_000)))
    assert len(folder) <= 2 * 64 + 1
    summaries = list(folder.finish())
    assert len(written) + sum(one.detail["count"] for one in summaries) == 20_000
    assert len(folder) == 0
    (everybody,) = [one for one in summaries if one.detail["scope"] == "all"]
    assert len(everybody.detail["hosts"]) == 9
    assert sum(everybody.detail["hosts"].values()) == everybody.detail["count"]


def test_a_summary_names_host_and_call() -> None:
    folder = make_folder()
    detail = {"call": "getParam", "key": "/secret", "node": "/arm", "unrelated": 1}
    offer(folder, *(denial(resource="getParam", detail=detail) for _ in range(5)))
    (one,) = folder.finish()
    assert one.caller_id == denial().caller_id
    assert {name: one.detail[name] for name in ("call", "key", "node")} == {
        "call": "getParam", "key": "/secret", "node": "/arm",
    }  # fmt: skip
    assert "unrelated" not in one.detail


def test_the_loudest_callers_are_named() -> None:
    folder = make_folder(keys_per_host=4)
    calls = ["setParam", "getParam", "deleteParam"]
    flood = [
        denial(f"/{number}", caller_id=f"/node{number % 3}", detail={"call": calls[number % 3]})
        for number in range(3000)
    ]
    offer(folder, *flood)
    (host,) = [one for one in folder.finish() if one.detail["scope"] == "host"]
    assert set(host.detail["callers"]) == {"/node0", "/node1", "/node2"}
    assert set(host.detail["calls"]) == set(calls)
    assert sum(host.detail["callers"].values()) == sum(host.detail["calls"].values()) == host.detail["count"]
    assert all(count > 900 for count in host.detail["callers"].values())


def test_long_names_are_bounded() -> None:
    folder = make_folder(keys_per_host=1)
    offer(folder, *(denial("/" + "x" * 100_000 + str(number)) for number in range(50)))
    (host,) = [one for one in folder.finish() if one.detail["scope"] == "host"]
    assert all(len(name) <= 256 for name in host.detail["resources"])


def test_zero_seconds_records_everything() -> None:
    folder = make_folder(seconds=0)
    same = [denial() for _ in range(10)]
    assert offer(folder, *same) == same


def test_would_deny_is_never_folded() -> None:
    """These records must stay complete, so that a policy can be learned from them."""
    folder = RecordFolder(FoldSettings(), lambda: "0" * 20, lambda: 0)
    record = denial(decision="would deny")
    assert [list(folder.offer(record, 0.0)) for _ in range(3)] == [[record]] * 3
    assert len(folder) == 0


def test_denials_of_different_parameters_are_separate() -> None:
    folder = RecordFolder(FoldSettings(), lambda: "0" * 20, lambda: 0)
    kinds = [
        denial(resource="getParam", detail={"call": "getParam", "key": "/a"}),
        denial(resource="getParam", detail={"call": "getParam", "key": "/b"}),
        denial(resource="getParam", detail={"call": "hasParam", "key": "/b"}),
    ]
    assert [list(folder.offer(kind, 0.0)) for kind in kinds] == [[kind] for kind in kinds]
    assert [list(folder.offer(kind, 0.0)) for kind in kinds] == [[], [], []]


def test_a_reported_count_is_added() -> None:
    folder = make_folder(seconds=10)
    flood = [denial(detail={"count": 1000}) for _ in range(10)]
    assert offer(folder, *flood) == flood[:1]
    assert [one.detail["count"] for one in folder.expire(10)] == [9000]
    varied = make_folder(seconds=10, keys_per_host=1)
    offer(varied, denial("/a"), denial("/b"), denial("/c", detail={"count": 50}))
    (host,) = [one for one in varied.expire(30) if one.detail["scope"] == "host"]
    assert host.detail["count"] == 50
    assert host.detail["resources"] == {"/c": 50}


def test_an_invalid_count_is_one() -> None:
    folder = make_folder(seconds=10)
    strange: tuple[object, ...] = (True, 0, -5, "9", 2.5, None)
    offer(folder, denial(), *(denial(detail={"count": one}) for one in strange))
    assert [one.detail["count"] for one in folder.expire(10)] == [len(strange)]


def test_invalid_text_can_be_stored() -> None:
    folder = make_folder(seconds=10)
    strange: dict[str, Any] = {"caller_id": "/\ud800", "reason": "\udcff", "detail": {"call": "\ud801"}}
    first, second = denial("/\udfff", **strange), denial("/\udfff", **strange)
    assert offer(folder, first, second) == [first]
    (key,) = folder.touched
    assert msgspec.json.encode(key)
    assert msgspec.json.encode(folder.state(key))
    (allowed,) = [denial("/\udfff", **strange | {"decision": "allow"})]
    assert [record.event for record in offer(folder, allowed)] == ["denials folded", "decision"]
    assert len(folder) == 0


def test_unknown_hosts_leave_named_hosts_their_kinds() -> None:
    folder = make_folder(keys=64, unknown=8)
    flood = [
        denial(
            f"/topic{number}", host=f"10.9.0.{number % 24}", caller_id=f"/n{number}", reason=f"no {number}",
            detail={"call": "registerPublisher"}, unknown=True,
        )
        for number in range(5000)
    ]  # fmt: skip
    written = offer(folder, *flood)
    assert len(written) == 9
    assert len(folder) == 9
    named = [denial(f"/{number}") for number in range(40)]
    assert offer(folder, *named) == named
    summaries = list(folder.finish())
    assert sum(one.detail["count"] for one in summaries) == 5000 - 9
    (together,) = [one for one in summaries if one.detail["scope"] == "unknown hosts"]
    assert together.host is None
    assert sum(together.detail["hosts"].values()) == together.detail["count"]
    assert len(together.detail["reasons"]) == 9
    assert all(one.caller_id is None and one.resource is None for one in summaries)


def test_a_reason_with_peer_text_is_one_kind() -> None:
    folder = make_folder(seconds=10)
    flood = [
        denial(reason=f"number {number} of '/x{number}' at /n{number} is too large", event="malformed")
        for number in range(1000)
    ]
    assert offer(folder, *flood) == flood[:1]
    (one,) = folder.expire(10)
    assert one.reason == flood[0].reason
    assert one.detail["count"] == sum(one.detail["reasons"].values()) == 999
    assert len(one.detail["reasons"]) == 9


def test_named_hosts_keep_a_line_each() -> None:
    folder = make_folder(keys=64, keys_per_host=16)
    offer(folder, *(denial(f"/{n}", host=f"10.1.0.{host}") for host in range(4) for n in range(50)))
    late = [denial(f"/{number}", host="10.2.0.1") for number in range(10)]
    assert offer(folder, *late) == late[:1]
    (mine,) = [one for one in folder.finish() if one.host == "10.2.0.1"]
    assert mine.detail["count"] == 9


def read(key: str, **fields: Any) -> AuditRecord:
    plain: dict[str, Any] = {"decision": "allow", "folds": True, "detail": {"call": "hasParam", "key": key}}
    return denial("hasParam", **(plain | fields))


def test_reads_are_folded_like_denials() -> None:
    folder = make_folder(seconds=10)
    same = [read("/a") for _ in range(500)]
    assert offer(folder, *same, read("/b"))[:1] == same[:1]
    (one,) = [found for found in folder.expire(10) if found.event == "repetitions folded"]
    assert (one.decision, one.resource, one.detail["key"], one.detail["count"]) == (
        "allow", "hasParam", "/a", 499,
    )  # fmt: skip


def test_reads_of_other_topics_are_not_folded() -> None:
    folder = make_folder()
    scan, image, again = (
        denial("", event="recording read", decision=None, folds=True, category=None, caller_id=None,
               reason=f"messages of {topic}, by eve", detail={"who": "eve", "topics": [topic]})
        for topic in ("/scan", "/image", "/scan")
    )  # fmt: skip
    assert offer(folder, scan, image, again) == [scan, image]


def test_reads_beyond_the_quota_are_recorded_in_full() -> None:
    folder = make_folder(keys=64, keys_per_host=16)
    varied = [read(f"/{number}") for number in range(1000)]
    assert offer(folder, *varied) == varied
    assert len(folder) == 16
    refused = [denial(f"/{number}") for number in range(10)]
    assert offer(folder, *refused) == refused


def test_a_denial_ends_the_folding_of_reads() -> None:
    folder = make_folder()
    offer(folder, read("/a"), read("/a"))
    refused = read("/a", decision="deny", folds=False)
    again = read("/a")
    assert [record.event for record in offer(folder, refused)] == ["repetitions folded", "decision"]
    assert offer(folder, again) == [again]


def test_another_key_ends_no_folding() -> None:
    folder = make_folder()
    flood = [one for n in range(100) for one in (read(f"/a/{n}"), read("/b", decision="deny", folds=False))]
    written = offer(folder, *flood)
    assert [one.detail["key"] for one in written].count("/b") == 1


def test_a_nodes_reads_of_its_own_parameters_are_one_record_with_their_list() -> None:
    folder = make_folder(seconds=10, keys_per_host=2)
    reads = [read(f"/n/gain_{number % 20}") for number in range(60)]
    assert offer(folder, *reads) == reads[:1]
    others = [
        read("/m/gain"),
        read("/nn/gain"),
        read("/n"),
        read("/n/" + "x" * 300),
        read("/n/a", caller_id="/m"),
    ]
    assert offer(folder, *others) == others
    assert offer(folder, read("/n/late")) == []
    (one, *_rest) = folder.expire(10)
    assert (one.event, one.caller_id, one.resource) == ("repetitions folded", "/n", "hasParam")
    assert one.detail["recorded_id"] == reads[0].id
    assert "key" not in one.detail
    assert one.detail["parameters"] == {"/n/gain_0": 2} | {
        f"/n/gain_{number}": 3 for number in range(1, 20)
    } | {"/n/late": 1}
    assert one.detail["count"] == sum(one.detail["parameters"].values())


@pytest.mark.parametrize("name", ["gain", "a_rather_long_name_of_a_parameter_" * 6])
def test_no_read_parameter_is_left_out_of_the_lists(name: str) -> None:
    """A list that is full is written at once, and a record of it fits into the log."""
    folder = make_folder(seconds=10)
    reads = [read(f"/n/{name}{number}") for number in range(5000)]
    written = offer(folder, *reads)
    lists = [one.detail["parameters"] for one in [*written[1:], *folder.finish()]]
    assert [name for one in lists for name in one] == [one.detail["key"] for one in reads[1:]]
    assert all(len(msgspec.json.encode(one)) < LARGEST_DETAIL / 2 for one in lists)
    assert len(lists) < 100


def test_a_denial_of_one_own_parameter_ends_the_folding() -> None:
    folder = make_folder()
    offer(folder, read("/n/a"), read("/n/b"))
    refused = read("/n/c", decision="deny", folds=False)
    summary, written = offer(folder, refused)
    assert (summary.detail["parameters"], written) == ({"/n/b": 1}, refused)
    again = read("/n/a")
    assert offer(folder, again) == [again]
    others = [read(f"/n/{name}", decision="deny", folds=False) for name in "de"]
    assert [record for record in offer(folder, *others) if record.decision == "deny"] == others


def test_lists_of_parameters_survive_a_crash() -> None:
    folder = make_folder()
    offer(folder, read("/n/a"), read("/n/b"))
    (key,) = folder.touched
    stored = msgspec.json.decode(msgspec.json.encode(folder.state(key)), type=FoldState)
    assert summary(stored, "s", 1, recovered=True).detail["parameters"] == {"/n/b": 1}


def test_events_beyond_the_budget_are_counted() -> None:
    folder = make_folder(keys=64, keys_per_host=4)
    opened = [
        denial(f"/t{n % 8}", event="connection opened", decision=None, folds=True, reason="")
        for n in range(800)
    ]
    written = offer(folder, *opened)
    assert len(written) == 5
    summaries = list(folder.finish())
    assert {one.event for one in summaries} == {"repetitions folded"}
    assert len(written) + sum(one.detail["count"] for one in summaries) == 800


def test_a_denied_caller_gets_a_recorded_id_or_none() -> None:
    for gathered in (1, 7, 400):
        folder = make_folder(keys_per_host=4, unknown=3)
        denials = [
            denial(f"/{number % 6}", f"10.0.0.{host}", unknown=host > 2, caller_id=f"/n{number % 5}")
            for number in range(100)
            for host in (1, 2, 3, 4)
        ]
        told: list[tuple[AuditRecord, str]] = []
        written: dict[str, AuditRecord] = {}
        for begin in range(0, len(denials), gathered):
            together = denials[begin : begin + gathered]
            told += [(one, folder.in_full(one)) for one in together]
            written |= {record.id: record for record in offer(folder, *together)}
        assert {found for _, found in told} == {"", *written}, gathered
        for one, found in told:
            kept = written.get(found, one)
            assert (kept.host, kept.resource, kept.caller_id) == (one.host, one.resource, one.caller_id)
