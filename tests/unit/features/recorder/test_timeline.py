import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import LogEntry
from appliance.features.recorder.bag_reader import BagReader, MessagePosition
from appliance.features.recorder.bag_writer import BagMessage, BagWriter
from appliance.features.recorder.recording_answers import Recording, Sender, Trigger
from appliance.features.recorder.timeline import MAX_EVENTS, messages_around, timeline
from tests.unit.features.recorder.test_bag_writer import HEADER, SECOND, body

BEGAN = 100 * SECOND
RECORDING = Recording(
    "a" * 20, BEGAN, BEGAN + 10 * SECOND - 1, [], [], 1, 1, 0, "", complete=True, why_not=""
)
RECORDS = {name: value for name, value in HEADER.items() if name != "host"} | {
    "topic": "/rosrv/records",
    "callerid": "/rosrv",
}


def record(number: int, **fields: Any) -> bytes:
    own = {"id": f"{number:020x}", "event": "decision", "severity": "info", "reason": "so", "detail": {}}
    return body(json.dumps(own | fields).encode())


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "a.bag"
    writer = BagWriter(path, {})
    first = writer.connect(HEADER)
    second = writer.connect(HEADER | {"callerid": "/other", "host": "10.0.0.2"})
    for part in range(4):
        for number, connection in enumerate((first, second)):
            start = BEGAN + part * 2 * SECOND + number * SECOND // 20
            writer.write(
                BagMessage(connection, start + step * SECOND // 10, body(b"%d.%d" % (part, step)))
                for step in range(20)
            )
    decided = writer.connect(RECORDS)
    writer.write([
        BagMessage(decided, BEGAN + SECOND, record(1, event="rest call")),
        BagMessage(decided, BEGAN + 2 * SECOND, record(2, event="message dropped", severity="warning")),
        BagMessage(decided, BEGAN + 3 * SECOND, record(3, decision="deny", severity="warning", host="10.0.0.9")),
        BagMessage(decided, BEGAN + 9 * SECOND, record(4, event="policy loaded", severity="notice")),
    ])  # fmt: skip
    writer.close()
    return path


def test_flows_and_events_are_in_their_columns(bag: Path) -> None:
    found = timeline(RECORDING, bag, columns=10)
    [flow] = found.topics
    assert (flow.topic, flow.counts) == ("/chatter", [20] * 8 + [0, 0])
    assert flow.senders == [Sender("/talker", "10.0.0.1"), Sender("/other", "10.0.0.2")]
    assert [(event.kind, event.record[-1]) for event in found.events] == [
        ("drop", "2"), ("denial", "3"), ("notice", "4"),
    ]  # fmt: skip
    assert {mark.kind: mark.counts.index(1) for mark in found.marks} == {"drop": 2, "denial": 3, "notice": 9}
    part = timeline(RECORDING, bag, BEGAN + 2 * SECOND, BEGAN + 4 * SECOND - 1, columns=4)
    assert part.topics[0].counts == [10] * 4
    assert [event.record[-1] for event in part.events] == ["2", "3"]
    with pytest.raises(ValueError, match="outside the recording"):
        timeline(RECORDING, bag, BEGAN + 20 * SECOND)


def test_the_columns_equal_a_naive_count(bag: Path) -> None:
    with BagReader.of(bag) as reader:
        times = [place.time for place, number in reader.messages({0, 1})]
    assert times == sorted(times)
    assert len(times) == 160
    for columns in (1, 7, 200, 1000):
        since, until = BEGAN + 123_456_789, BEGAN + 7_654_321_987
        width = (until - since) // columns + 1
        naive = [0] * columns
        for time in times:
            if since <= time <= until:
                naive[(time - since) // width] += 1
        assert timeline(RECORDING, bag, since, until, columns).topics[0].counts == naive


def test_messages_around_a_moment_are_read(bag: Path) -> None:
    found = messages_around(RECORDING, bag, BEGAN + 2 * SECOND, neighbours=2)
    assert [(one.time - BEGAN, one.sender.node, one.fields["data"]) for one in found.messages] == [
        (1_900_000_000, "/talker", "0.19"),
        (1_950_000_000, "/other", "0.19"),
        (2_000_000_000, "/talker", "1.0"),
        (2_050_000_000, "/other", "1.0"),
        (2_100_000_000, "/talker", "1.1"),
    ]
    assert found.chosen == 2
    last = MessagePosition.parse(found.messages[-1].place)
    assert last is not None
    following = messages_around(RECORDING, bag, last, neighbours=2)
    assert following.messages[following.chosen] == found.messages[-1]
    assert [message.fields["data"] for message in following.messages[:2]] == ["1.0", "1.0"]
    assert messages_around(RECORDING, bag, 0, neighbours=3).chosen == 0
    end = messages_around(RECORDING, bag, 2**60, neighbours=3)
    assert (end.chosen, len(end.messages)) == (3, 4)
    assert messages_around(RECORDING, bag, BEGAN, ["/nothing"]).messages == []


def test_the_chosen_message_of_a_time_is_the_last_until_then(bag: Path) -> None:
    recorded_messages = messages_around(RECORDING, bag, BEGAN + 2 * SECOND + SECOND // 50, neighbours=2)
    chosen = recorded_messages.messages[recorded_messages.chosen]
    assert (chosen.time - BEGAN, chosen.fields["data"]) == (2 * SECOND, "1.0")


def test_the_chosen_message_of_a_record_is_the_one_that_it_is_about(tmp_path: Path) -> None:
    path, judged = tmp_path / "a.bag", BEGAN + SECOND + 1_234_567
    happened = datetime.fromtimestamp(judged / 1e9, UTC).isoformat()
    detail = {"happened": happened, "before": body(b"7.5").hex()}
    about = {"event": "message dropped", "resource": "/chatter", "host": "10.0.0.1", "caller_id": "/talker"}
    writer = BagWriter(path, {})
    talker = writer.connect(HEADER)
    other = writer.connect(HEADER | {"callerid": "/other", "host": "10.0.0.2"})
    said = [(talker, judged - SECOND, b"0.1"), *((talker, judged, text) for text in (b"0.3", b"7.5", b"0.4"))]
    said += [
        (other, judged, b"7.5"),
        (other, judged + SECOND // 50, b"9"),
        (talker, judged + SECOND // 8, b"0.5"),
    ]
    writer.write([BagMessage(number, time, body(text)) for number, time, text in said])
    records = writer.connect(RECORDS)
    writer.write([
        BagMessage(records, judged + SECOND // 10, record(1, **about, detail=detail)),
        BagMessage(records, judged + SECOND // 10, record(2, event="decision")),
    ])  # fmt: skip
    writer.close()

    def chosen(at: str, *topics: str) -> tuple[str, str]:
        recorded_messages = messages_around(RECORDING, path, at, topics)
        message = recorded_messages.messages[recorded_messages.chosen]
        return message.sender.node, message.fields["data"]

    assert chosen(f"{1:020x}") == chosen(f"{1:020x}", "/chatter") == ("/talker", "7.5")
    assert chosen(f"{2:020x}") == ("/other", "9")
    with pytest.raises(ValueError, match="has no record 00000000000000000003"):
        chosen(f"{3:020x}")
    trigger = Trigger(BEGAN + SECOND // 2, "order", f"{3:020x}", "by hand")
    found = messages_around(msgspec.structs.replace(RECORDING, triggers=[trigger]), path, trigger.record)
    assert found.messages[found.chosen].fields["data"] == "0.1"


def test_pages_of_one_moment_end(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.bag", {})
    number = writer.connect(HEADER)
    writer.write(BagMessage(number, BEGAN, body(b"%d" % step)) for step in range(9))
    writer.close()
    seen: list[str] = []
    at: int | MessagePosition = 0
    while True:
        found = messages_around(RECORDING, tmp_path / "a.bag", at, neighbours=1)
        seen += [message.fields["data"] for message in found.messages[found.chosen + (at != 0) :]]
        after = MessagePosition.parse(found.messages[-1].place)
        assert after is not None
        if after == at:
            break
        at = after
    assert seen == [str(step) for step in range(9)]


@pytest.mark.parametrize("text", ["2026-02-30", "10000-01-01", "2026-03-01", "", "1795155949800000000-4109"])
def test_an_impossible_date_is_refused(text: str) -> None:
    assert MessagePosition.parse(text) is None
    position = MessagePosition(1795155949800000000, 4109, 2210)
    assert MessagePosition.parse(str(position)) == position


def test_publishers_cannot_forge_events(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.bag", {})
    forger = writer.connect(RECORDS | {"host": "10.0.0.66"})
    writer.write([BagMessage(forger, BEGAN, record(1, event="message dropped", severity="alarm"))])
    writer.close()
    found = timeline(RECORDING, tmp_path / "a.bag")
    assert (found.events, found.marks) == ([], [])
    assert [(flow.topic, sum(flow.counts)) for flow in found.topics] == [("/rosrv/records", 1)]
    assert len(messages_around(RECORDING, tmp_path / "a.bag", BEGAN).messages) == 1


def test_a_flood_of_events_is_counted(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.bag", {})
    decided = writer.connect(RECORDS)
    writer.write(
        BagMessage(decided, BEGAN + number, record(number, decision="deny"))
        for number in range(3 * MAX_EVENTS)
    )
    writer.close()
    for asked, first in ((None, 0), (MAX_EVENTS - 1, 0), (2 * MAX_EVENTS, 3 * MAX_EVENTS // 2)):
        about = "" if asked is None else f"{asked:020x}"
        found = timeline(RECORDING, tmp_path / "a.bag", record=about)
        assert [int(event.record, 16) for event in found.events] == list(range(first, first + MAX_EVENTS))
        assert (found.more_events, sum(found.marks[0].counts)) == (2 * MAX_EVENTS, 3 * MAX_EVENTS)


def test_counted_events_are_spread_over_their_time(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.bag", {})
    detail = {"count": 999, "first_time": BEGAN + SECOND, "last_time": BEGAN + 4 * SECOND - 1}
    said = record(1, event="message dropped", severity="warning", detail=detail)
    writer.write([BagMessage(writer.connect(RECORDS), BEGAN + 5 * SECOND, said)])
    writer.close()
    found = timeline(RECORDING, tmp_path / "a.bag", columns=10)
    assert found.marks[0].counts == [0, 333, 333, 333, 0, 0, 0, 0, 0, 0]
    assert [event.times for event in found.events] == [999]
    edges = [BEGAN, BEGAN + 1_234_567_890, BEGAN + 2_345_678_901, BEGAN + 9 * SECOND]
    parts = [
        timeline(RECORDING, tmp_path / "a.bag", *part, 7)
        for part in ((edges[0], edges[1] - 1), (edges[1], edges[2] - 1), (edges[2], edges[3]))
    ]
    assert sum(sum(part.marks[0].counts) for part in parts) == 999


def test_repetitions_counted_after_the_end_are_in_the_lanes(
    bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = RECORDING.ended
    spans = [(ended - SECOND + 1, ended + SECOND), (ended + 1, ended + SECOND), (None, None)]
    later = [
        LogEntry(number, AuditRecord(
            id=f"{number:020x}", time=ended + 5 * SECOND, event="denials folded", severity=Severity.WARNING,
            decision="deny", detail={"count": 10, "first_time": first, "last_time": last},
        ))
        for number, (first, last) in enumerate(spans)
    ]  # fmt: skip
    monkeypatch.setattr("appliance.features.recorder.timeline.export", lambda _log, _wanted: iter(later))
    found = timeline(RECORDING, bag, log=bag)
    [denials] = [mark.counts for mark in found.marks if mark.kind == "denial"]
    assert sum(denials) == 1 + 5
    assert len(found.events) == 3


@pytest.mark.parametrize("torn", [b"no bag", b"#ROSBAG V2.0\n", None])
def test_an_incomplete_bag_is_an_error(bag: Path, torn: bytes | None) -> None:
    bag.write_bytes(bag.read_bytes()[:-50] if torn is None else torn)
    with pytest.raises(ValueError, match="bag"):
        timeline(RECORDING, bag)
