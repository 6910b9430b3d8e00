"""Tests of folding repeated denials, with a clock that the test moves."""

import itertools
from typing import Any

import msgspec

from appliance.audit.folding import Folder, FoldSettings
from appliance.audit.record import Record, RuleReference
from appliance.quotas.pool import Bounds

_numbers = itertools.count(1)


def make_folder(
    seconds: float = 10.0, keys: int = 4096, keys_per_host: int = 256, strangers: int = 8
) -> Folder:
    """A folder whose summaries are called s1, s2, ..., with room for so many kinds."""
    ids = itertools.count(1)
    bounds = Bounds(keys, min(keys_per_host, keys), min(strangers, keys), 0)
    settings = FoldSettings(seconds=seconds, kinds=bounds, read_kinds=bounds)
    return Folder(settings, lambda: f"s{next(ids)}", lambda: 1)


def denial(resource: str = "/a", host: str = "10.0.0.1", **fields: Any) -> Record:
    """A denial with an id of its own."""
    plain: dict[str, Any] = {
        "event": "decision", "decision": "deny", "caller_id": "/n", "category": "call", "reason": "no",
    }  # fmt: skip
    return Record(id=f"r{next(_numbers)}", time=1, host=host, resource=resource, **(plain | fields))


def offer(folder: Folder, *records: Record, now: float = 0) -> list[Record]:
    """What is written for these records."""
    return [written for record in records for written in folder.offer(record, now)]


def test_first_in_full_then_counted() -> None:
    """The first denial is recorded as it is; its repetitions are one summary with count, first and last."""
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


def test_summaries_go_on_while_it_repeats() -> None:
    """A denial that goes on repeating has a summary every period, and is in full again after a quiet one."""
    folder = make_folder(seconds=10)
    offer(folder, denial(), denial(), now=0)
    assert [one.detail["count"] for one in folder.expire(10)] == [1]
    assert offer(folder, denial(), denial(), now=11) == []
    assert [one.detail["count"] for one in folder.expire(20)] == [2]
    assert list(folder.expire(30)) == []
    assert len(folder) == 0
    again = denial()
    assert offer(folder, again, now=31) == [again]


def test_what_differs_is_not_folded() -> None:
    """Another host, caller, resource, reason, rule or policy revision is another kind, recorded in full."""
    folder = make_folder()
    kinds = [
        denial(), denial(reason="other"), denial(host="10.0.0.2"), denial(caller_id="/other"), denial("/b"),
        denial(rule=RuleReference("Publishers", "/**", "robot.ini", 3)),
        denial(revision=9), denial(category="read"), denial(decision="would deny"),
    ]  # fmt: skip
    assert offer(folder, *kinds) == kinds


def test_an_allow_ends_the_folding_it_contradicts() -> None:
    """The summary of denials comes before the allow of the same request, and the next denial is in full."""
    folder = make_folder()
    offer(folder, denial(), denial())
    allowed = denial(decision="allow")
    written = offer(folder, allowed)
    assert [one.event for one in written] == ["denials folded", "decision"]
    assert written[1] is allowed
    again = denial()
    assert offer(folder, again) == [again]


def test_allows_that_change_something_are_never_folded() -> None:
    """Every allow that changes something is recorded in full."""
    folder = make_folder()
    allows = [denial(decision="allow") for _ in range(50)]
    assert offer(folder, *allows) == allows


def test_varied_names_are_folded_per_host() -> None:
    """Who varies names costs bounded memory and records, every denial is counted, others are not hit."""
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
    """Even with an address for each denial memory is bounded and every denial is counted."""
    folder = make_folder(keys=64)
    written = offer(folder, *(denial(host=f"10.1.{n // 256}.{n % 256}") for n in range(20_000)))
    assert len(folder) <= 2 * 64 + 1
    summaries = list(folder.finish())
    assert len(written) + sum(one.detail["count"] for one in summaries) == 20_000
    assert len(folder) == 0
    (everybody,) = [one for one in summaries if one.detail["scope"] == "all"]
    assert len(everybody.detail["hosts"]) == 9
    assert sum(everybody.detail["hosts"].values()) == everybody.detail["count"]


def test_a_summary_says_who_and_what() -> None:
    """Which call of which node on what was repeated is in the summary itself, not only in the record it points to."""
    folder = make_folder()
    detail = {"call": "getParam", "key": "/secret", "node": "/arm", "unrelated": 1}
    offer(folder, *(denial(resource="getParam", detail=detail) for _ in range(5)))
    (one,) = folder.finish()
    assert one.caller_id == denial().caller_id
    assert {name: one.detail[name] for name in ("call", "key", "node")} == {
        "call": "getParam", "key": "/secret", "node": "/arm",
    }  # fmt: skip
    assert "unrelated" not in one.detail


def test_who_is_behind_a_flood_of_many_names() -> None:
    """A host that is folded as a whole is still told by caller and call: the loudest are there with their counts."""
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
    """Names of strangers take bounded room in a summary, however long they are."""
    folder = make_folder(keys_per_host=1)
    offer(folder, *(denial("/" + "x" * 100_000 + str(number)) for number in range(50)))
    (host,) = [one for one in folder.finish() if one.detail["scope"] == "host"]
    assert all(len(name) <= 256 for name in host.detail["resources"])


def test_zero_seconds_records_everything() -> None:
    """With folding off every denial is recorded in full."""
    folder = make_folder(seconds=0)
    same = [denial() for _ in range(10)]
    assert offer(folder, *same) == same


def test_what_passed_on_trial_is_never_folded() -> None:
    """Every `would deny` is a record of its own, like every allow: a policy can be learned from them."""
    folder = Folder(FoldSettings(), lambda: "0" * 20, lambda: 0)
    record = denial(decision="would deny")
    assert [list(folder.offer(record, 0.0)) for _ in range(3)] == [[record]] * 3
    assert len(folder) == 0


def test_denials_of_different_parameters_are_different() -> None:
    """The same call on another key, or another call, is recorded in full; the same again is counted."""
    folder = Folder(FoldSettings(), lambda: "0" * 20, lambda: 0)
    kinds = [
        denial(resource="getParam", detail={"call": "getParam", "key": "/a"}),
        denial(resource="getParam", detail={"call": "getParam", "key": "/b"}),
        denial(resource="getParam", detail={"call": "hasParam", "key": "/b"}),
    ]
    assert [list(folder.offer(one, 0.0)) for one in kinds] == [[one] for one in kinds]
    assert [list(folder.offer(one, 0.0)) for one in kinds] == [[], [], []]


def test_what_was_counted_before_counts_as_many() -> None:
    """A denial that stands for many, because its reporter counted them, is as many in the summary and its tallies."""
    folder = make_folder(seconds=10)
    flood = [denial(detail={"count": 1000}) for _ in range(10)]
    assert offer(folder, *flood) == flood[:1]
    assert [one.detail["count"] for one in folder.expire(10)] == [9000]
    varied = make_folder(seconds=10, keys_per_host=1)
    offer(varied, denial("/a"), denial("/b"), denial("/c", detail={"count": 50}))
    (host,) = [one for one in varied.expire(30) if one.detail["scope"] == "host"]
    assert host.detail["count"] == 50
    assert host.detail["resources"] == {"/c": 50}


def test_a_count_that_is_none_counts_once() -> None:
    """What stands under `count` and is no positive number is one denial."""
    folder = make_folder(seconds=10)
    strange: tuple[object, ...] = (True, 0, -5, "9", 2.5, None)
    offer(folder, denial(), *(denial(detail={"count": one}) for one in strange))
    assert [one.detail["count"] for one in folder.expire(10)] == [len(strange)]


def test_what_is_no_text_can_be_kept() -> None:
    """Names and reasons with what no disk takes are counted like others, and key and state can be written."""
    folder = make_folder(seconds=10)
    strange: dict[str, Any] = {"caller_id": "/\ud800", "reason": "\udcff", "detail": {"call": "\ud801"}}
    first, second = denial("/\udfff", **strange), denial("/\udfff", **strange)
    assert offer(folder, first, second) == [first]
    (key,) = folder.touched
    assert msgspec.json.encode(key)
    assert msgspec.json.encode(folder.state(key))
    (allowed,) = [denial("/\udfff", **strange | {"decision": "allow"})]
    assert [one.event for one in offer(folder, allowed)] == ["denials folded", "decision"]
    assert len(folder) == 0


def test_strangers_with_reasons_of_their_own_take_no_kind_of_a_named_host() -> None:
    """Strangers who put a number of their choice into everything have a few kinds; a named host keeps its own."""
    folder = make_folder(keys=64, strangers=8)
    flood = [
        denial(
            f"/topic{number}", host=f"10.9.0.{number % 24}", caller_id=f"/n{number}", reason=f"no {number}",
            detail={"call": "registerPublisher"}, stranger=True,
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
    (together,) = [one for one in summaries if one.detail["scope"] == "strangers"]
    assert together.host is None
    assert sum(together.detail["hosts"].values()) == together.detail["count"]
    assert len(together.detail["reasons"]) == 9
    assert all(one.caller_id is None and one.resource is None for one in summaries)


def test_what_a_peer_puts_into_a_reason_makes_no_kind() -> None:
    """Numbers, names and quotations in the reason of a refused request are one kind, counted in its summary."""
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


def test_many_named_hosts_keep_a_line_each() -> None:
    """With all kinds taken by others, a named host's denials are still counted under its own address."""
    folder = make_folder(keys=64, keys_per_host=16)
    offer(folder, *(denial(f"/{n}", host=f"10.1.0.{host}") for host in range(4) for n in range(50)))
    late = [denial(f"/{number}", host="10.2.0.1") for number in range(10)]
    assert offer(folder, *late) == late[:1]
    (mine,) = [one for one in folder.finish() if one.host == "10.2.0.1"]
    assert mine.detail["count"] == 9


def read(key: str, **fields: Any) -> Record:
    """An allowed call that reads a parameter."""
    plain: dict[str, Any] = {"decision": "allow", "folds": True, "detail": {"call": "hasParam", "key": key}}
    return denial("hasParam", **(plain | fields))


def test_reads_are_folded_as_denials_are() -> None:
    """The first read of its kind is in full; the rest is one summary that says who read what, and how often."""
    folder = make_folder(seconds=10)
    same = [read("/a") for _ in range(500)]
    assert offer(folder, *same, read("/b"))[:1] == same[:1]
    (one,) = [found for found in folder.expire(10) if found.event == "repetitions folded"]
    assert (one.decision, one.resource, one.detail["key"], one.detail["count"]) == (
        "allow", "hasParam", "/a", 499,
    )  # fmt: skip


def test_a_reading_of_other_topics_is_no_repetition() -> None:
    """Who read which topics of a recording stands in full; the same again is counted."""
    folder = make_folder()
    scan, image, again = (
        denial("", event="recording read", decision=None, folds=True, category=None, caller_id=None,
               reason=f"messages of {topic}, by eve", detail={"who": "eve", "topics": [topic]})
        for topic in ("/scan", "/image", "/scan")
    )  # fmt: skip
    assert offer(folder, scan, image, again) == [scan, image]


def test_reads_beyond_the_share_are_recorded_in_full() -> None:
    """No read loses its key: past the share of kinds each is a record of its own, and takes no kind of a denial."""
    folder = make_folder(keys=64, keys_per_host=16)
    varied = [read(f"/{number}") for number in range(1000)]
    assert offer(folder, *varied) == varied
    assert len(folder) == 16
    refused = [denial(f"/{number}") for number in range(10)]
    assert offer(folder, *refused) == refused


def test_a_denial_ends_the_reads_it_contradicts() -> None:
    """What was read before a denial is summarised before it; the read after it is in full again."""
    folder = make_folder()
    offer(folder, read("/a"), read("/a"))
    refused = read("/a", decision="deny", folds=False)
    again = read("/a")
    assert [one.event for one in offer(folder, refused)] == ["repetitions folded", "decision"]
    assert offer(folder, again) == [again]


def test_another_key_ends_nothing() -> None:
    """Denials of one parameter go on being counted while the same call on another one is allowed."""
    folder = make_folder()
    flood = [one for n in range(100) for one in (read(f"/a/{n}"), read("/b", decision="deny", folds=False))]
    written = offer(folder, *flood)
    assert [one.detail["key"] for one in written].count("/b") == 1


def test_events_of_a_host_beyond_its_budget_are_counted() -> None:
    """What no call waits for is counted once its host is beyond its budget, by kind and past that by host."""
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


def test_who_is_denied_is_told_the_id_of_a_record_or_none() -> None:
    """Whatever is over, or of a stranger, and whether it is offered one by one or many at once."""
    for gathered in (1, 7, 400):
        folder = make_folder(keys_per_host=4, strangers=3)
        denials = [
            denial(f"/{number % 6}", f"10.0.0.{host}", stranger=host > 2, caller_id=f"/n{number % 5}")
            for number in range(100)
            for host in (1, 2, 3, 4)
        ]
        told: list[tuple[Record, str]] = []
        written: dict[str, Record] = {}
        for begin in range(0, len(denials), gathered):
            together = denials[begin : begin + gathered]
            told += [(one, folder.in_full(one)) for one in together]
            written |= {record.id: record for record in offer(folder, *together)}
        assert {found for _, found in told} == {"", *written}, gathered
        for one, found in told:
            kept = written.get(found, one)
            assert (kept.host, kept.resource, kept.caller_id) == (one.host, one.resource, one.caller_id)
