import hashlib
import json
import mmap
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rosbags.rosbag1 import Reader

from appliance.channel import messages
from appliance.features.recorder import recorder_link
from appliance.features.recorder.excluded_topics import NAMED
from appliance.features.recorder.recorder import SETTLE_SECONDS, Recorder
from appliance.features.recorder.recorder_ring import ExcludedStream
from appliance.features.recorder.recording import RecordingInProgress
from appliance.features.recorder.recording_answers import OPERATORS, Recording, Trigger, TriggerKind
from appliance.features.recorder.recording_store import MAX_TEMPORARY, RecordingStore
from appliance.features.recorder.ring import LEFT_OUT, SMALLEST, RingWriter
from appliance.features.recorder.settings import RecorderRules
from tests.support.audit import decision, settle
from tests.support.engines import open_log
from tests.unit.features.recorder.test_ring import HEADER, Clock, frame, opened

SECOND = 1_000_000_000
BEGAN = 1_000 * SECOND
TEXT = (5).to_bytes(4, "little") + b"hello"


class Scene:
    def __init__(self, folder: Path, *, disk: int = 64 << 20, **rules: Any) -> None:
        self.clock = Clock(BEGAN)
        self.set = 0
        self.disk = disk
        self.folder = folder / "recordings"
        self.folder.mkdir(exist_ok=True)
        self.log = open_log(folder / "audit.db", clock=self.clock)
        settle(self.log)
        self.rules = RecorderRules(**{"enabled": True, "before": 10, "after": 5, "longest": 60} | rules)
        self.memory = memoryview(mmap.mmap(-1, SMALLEST))
        self.born = BEGAN
        self.writer = RingWriter(self.memory, topic_share=0.25, host_share=0.5, seconds=10, clock=self.clock)
        self.stream = self.writer.open("/chatter", "10.0.0.1", HEADER)
        self.said = 0
        self.recorder = self.make_recorder()

    def begin_anew(self) -> None:
        self.recorder.close()
        self.recorder = self.make_recorder()

    def make_recorder(self) -> Recorder:
        store = RecordingStore(self.folder, disk=self.disk, reserve=1 << 20, seconds=None, clock=lambda: 0)
        return Recorder(
            self.rules,
            store,
            self.log.path,
            [self.memory],
            memory=self.born,
            ahead=0,
            clock=self.clock,
            steady=lambda: self.clock.now - self.set,
        )

    def set_clock(self, seconds: float) -> None:
        self.clock.now += int(seconds * SECOND)
        self.set += int(seconds * SECOND)

    def say(self, body: bytes = TEXT) -> None:
        assert self.stream is not None
        self.said += 1
        self.stream.write(memoryview(frame(body)), 1, self.said)

    def happen(self, event: str = "message dropped", **fields: Any) -> str:
        record = decision(self.log, **{"event": event, "decision": None, "time": self.clock.now} | fields)
        self.log.record(record)
        settle(self.log)
        return record.id

    def later(self, seconds: float, *said: Any) -> list[messages.Message]:
        self.clock.now += int(seconds * SECOND)
        return self.recorder.step(said)

    def closed(self, answers: list[messages.Message]) -> list[Recording]:
        return [answer.recording for answer in answers if isinstance(answer, recorder_link.RecordingClosed)]

    def bag(self, recording: Recording) -> list[tuple[str, int, bytes]]:
        path = self.folder / recording.id / "recording.bag"
        assert hashlib.sha256(path.read_bytes()).hexdigest() == recording.sha256
        assert path.stat().st_size == recording.size
        with Reader(path) as reader:
            return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    scene = Scene(tmp_path)
    scene.say()
    yield scene
    scene.log.close()


def test_before_and_after(scene: Scene) -> None:
    scene.later(20)
    scene.say(TEXT.replace(b"hello", b"alarm"))
    scene.later(1)
    where: dict[str, Any] = {"host": "10.0.0.1", "caller_id": "/voice", "resource": "/chatter"}
    dropped = scene.happen(reason="too fast", **where, detail={"monitor": "limit"})
    assert not scene.closed(scene.later(0.2))
    scene.say()
    assert not scene.closed(scene.later(4.9))
    scene.say()  # after the recording's end
    [recording] = scene.closed(scene.later(SETTLE_SECONDS + 0.1))
    assert recording == scene.closed(scene.later(0, recorder_link.RecordingsAsked()))[0]
    happened = BEGAN + 21 * SECOND
    assert (recording.began, recording.ended) == (happened - 10 * SECOND, happened + 5 * SECOND)
    assert (recording.complete, recording.why_not) == (True, "")
    [trigger] = recording.triggers
    assert trigger.equal
    assert msgspec.structs.replace(trigger, equal="") == Trigger(
        happened, "drop", dropped, "message dropped: too fast", monitor="limit", **where
    )
    [topic] = recording.topics
    assert (topic.topic, topic.type, topic.messages, topic.missed) == ("/chatter", "std_msgs/String", 2, 0)
    found = scene.bag(recording)
    alarm = TEXT.replace(b"hello", b"alarm")
    assert [data for name, _time, data in found if name == "/chatter"] == [alarm, TEXT]
    [(_name, time, record)] = [row for row in found if row[0] == "/rosrv/records"]
    assert (time, json.loads(record[4:])["id"]) == (happened, dropped)
    assert [time for name, time, _data in found if name == "/rosrv/log"] == [happened]
    kept = scene.folder / recording.id
    assert msgspec.json.decode((kept / "recording.json").read_bytes(), type=Recording) == recording
    assert {path.name for path in kept.iterdir()} == {"recording.bag", "recording.json", "since"}


def test_a_recording_of_the_memory_is_temporary(scene: Scene) -> None:
    trigger = Trigger(BEGAN, "order", "r", "eve: of what is in memory")

    def asked(since: int, until: int) -> messages.Message:
        order = msgspec.structs.replace(trigger, time=scene.clock.now)
        [answer] = scene.later(0, recorder_link.MemoryWanted(1, order, since, until))
        return answer

    def lent(since: int, until: int) -> Recording:
        answer = asked(since, until)
        assert isinstance(answer, recorder_link.MemoryLent), answer
        return answer.recording

    def there() -> set[str]:
        return {path.name for path in scene.folder.iterdir()}

    scene.later(20)
    scene.say(TEXT.replace(b"hello", b"alarm"))
    scene.later(1)
    scene.say()
    first = lent(0, scene.clock.now)
    assert (first.began, first.ended) == (BEGAN + 11 * SECOND, BEGAN + 21 * SECOND)  # `before` seconds
    assert [data for _topic, _time, data in scene.bag(first)] == [TEXT.replace(b"hello", b"alarm"), TEXT]
    second = lent(BEGAN + 21 * SECOND, scene.clock.now + SECOND)
    assert (second.ended, len(scene.bag(second))) == (scene.clock.now, 1)
    assert there() == {first.id, second.id}
    shutil.rmtree(scene.folder / first.id)  # by hand, which hinders no later one
    [refused] = scene.later(0, recorder_link.MemoryWanted(2, trigger, 0, BEGAN + 5 * SECOND))
    assert isinstance(refused, recorder_link.RecordingRefused)
    assert (refused.unknown, "the last 10 seconds" in refused.reason) == (True, True)
    [stated, *_rest] = scene.later(0, recorder_link.RecordingsAsked())
    assert stated == recorder_link.RecordingsStated([])
    scene.later(601)
    assert there() == set()
    scene.say()
    several = {lent(0, scene.clock.now).id for _order in range(MAX_TEMPORARY)}
    busy = asked(0, scene.clock.now)  # a recording that a user is about to open stays
    assert isinstance(busy, recorder_link.RecordingRefused)
    assert (busy.unknown, "half a minute" in busy.reason) == (False, True)
    assert there() == several
    scene.later(31)
    last = lent(scene.clock.now, scene.clock.now)
    assert (last.id in there(), len(there() & several)) == (True, MAX_TEMPORARY - 1)
    scene.begin_anew()
    assert there() == set()
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(
            RecordingInProgress, "finish", lambda made, *_given: sys.exit(made.leave())
        )  # the recorder is killed
        lent(0, scene.clock.now)
    assert there()
    scene.begin_anew()
    assert there() == set()
    assert not scene.closed(scene.later(60))


def test_triggers_that_overlap_make_one_recording(scene: Scene) -> None:
    scene.happen()
    scene.later(0.1)
    for _second in range(20):
        assert not scene.closed(scene.later(4))
        scene.happen()
        if scene.clock.now >= BEGAN + 56 * SECOND:
            break
    answers = scene.later(0.1) + scene.later(10)
    [recording] = scene.closed(answers)
    assert recording.ended == BEGAN + 60 * SECOND
    assert len(recording.triggers) == 15
    scene.happen()
    scene.later(0.1)
    assert scene.closed(scene.later(11))[0].began == recording.ended


def test_a_flood_of_triggers_does_not_fill_the_disk(tmp_path: Path) -> None:
    scene = Scene(tmp_path, per_hour=3)
    told: list[messages.Message] = []
    for _minute in range(10):
        scene.happen()
        told += scene.later(0.1) + scene.later(10)
    assert len(scene.closed(told)) == 3
    [missed] = [answer for answer in told if isinstance(answer, recorder_link.RecordingMissed)]
    assert "recorder.per_hour" in missed.reason
    scene.happen("monitor fault")
    assert len(scene.closed(scene.later(0.1) + scene.later(10))) == 1
    order = recorder_link.RecordingRequested(7, Trigger(scene.clock.now, "order", "id", "somebody"), 5, 2)
    [begun] = [one for one in scene.later(0, order) if isinstance(one, recorder_link.RecordingStarted)]
    assert (begun.number, begun.ends) == (7, scene.clock.now + 2 * SECOND)
    assert scene.closed(scene.later(3))[0].id == begun.id
    scene.log.close()


def planned(scene: Scene, recording_id: str, charged_to: str) -> str:
    return scene.happen(detail={"recording": recording_id, "charged_to": charged_to})


def test_a_planned_recording_is_made(scene: Scene) -> None:
    first = planned(scene, "a" * 20, "10.0.0.9")
    scene.later(1)
    second = planned(scene, "a" * 20, "10.0.0.9")
    [recording] = scene.closed(scene.later(1) + scene.later(10))
    assert (recording.id, recording.charged_to) == ("a" * 20, "10.0.0.9")
    assert [trigger.record for trigger in recording.triggers] == [first, second]
    scene.happen(detail={"not_recorded": "this hour is used up"})
    answers = scene.later(1) + scene.later(10)
    assert scene.closed(answers) == []
    [missed] = [answer for answer in answers if isinstance(answer, recorder_link.RecordingMissed)]
    assert missed.reason == "this hour is used up"


def test_a_guest_does_not_change_the_robots_recording(scene: Scene) -> None:
    planned(scene, "a" * 20, "10.0.0.9")
    scene.later(1)
    planned(scene, "b" * 20, "robot")
    scene.later(1)
    scene.begin_anew()
    answers: list[messages.Message] = []
    for _second in range(20):
        planned(scene, "a" * 20, "10.0.0.9")
        answers += scene.later(1)
    [robot] = scene.closed(answers)
    assert (robot.id, robot.charged_to, len(robot.triggers)) == ("b" * 20, "robot", 1)
    assert robot.ended - robot.triggers[0].time == 5 * SECOND
    [guest] = scene.closed(scene.later(10))
    assert (guest.id, len(guest.triggers)) == ("a" * 20, 21)


def test_a_recording_that_cannot_be_made_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(tmp_path)
    monkeypatch.setattr(RecordingStore, "free", property(lambda _self: 0))
    for name in ("a" * 20, "b" * 20):
        record = planned(scene, name, "robot")
        [missed] = [one for one in scene.later(1) if isinstance(one, recorder_link.RecordingMissed)]
        assert (missed.planned, missed.trigger.record) == (name, record)
        needed = f"0 MB are free at {tmp_path}/recordings, and a recording needs"
        assert missed.reason.startswith(f"the disk is nearly full: {needed} ")
    scene.log.close()


@pytest.mark.parametrize("what", ["order", "service"])
@pytest.mark.parametrize("arrival", ["stop first", "order first", "earlier plan", "ended", "again"])
def test_a_record_names_a_recording_that_exists_or_is_reported(
    scene: Scene, what: TriggerKind, arrival: str
) -> None:
    """Control plans a recording for the record of a stop while an operator or a node orders one of the same owner."""
    charged_to = {"order": OPERATORS, "service": "robot"}[what]

    def ordered() -> recorder_link.RecordingRequested:
        return recorder_link.RecordingRequested(
            1, Trigger(scene.clock.now, what, "id", "eve", charged_to), 5, 5
        )

    scene.later(20)
    x, told = "a" * 20, []
    if arrival == "stop first":  # the order wakes the recorder, which had not read the log
        planned(scene, x, "robot")
        told += scene.later(0.1, ordered())
    else:
        told += scene.later(0.1, ordered())
        if arrival == "ended":  # the record is read late
            stopped = scene.clock.now
            told += scene.later(11)
            scene.happen("stop begun", time=stopped, detail={"recording": x, "charged_to": "robot"})
        else:
            scene.clock.now += {"order first": 0, "earlier plan": 3 * SECOND, "again": 2 * SECOND}[arrival]
            planned(scene, x, "robot")
    told += scene.later(0.1)
    if arrival == "again":
        scene.begin_anew()
    told += scene.later(0.1) + scene.later(9) + scene.later(9)
    [recording] = scene.closed(told)
    missed = [one for one in told if isinstance(one, recorder_link.RecordingMissed)]
    assert {recording.id, *(one.planned for one in missed)} >= {x}
    assert (recording.id == x) == (arrival == "stop first") == (not missed)
    for one in missed:
        assert recording.id in one.reason
        assert one.instead is None or one.instead.id == recording.id
        assert (one.instead is None) == (arrival == "ended")
        assert recording.began <= one.trigger.time <= recording.ended


def test_a_flood_of_service_calls_does_not_fill_the_disk(tmp_path: Path) -> None:
    scene = Scene(tmp_path, per_hour=2)
    told: list[messages.Message] = []
    for number in range(6):
        call = recorder_link.RecordingRequested(
            number, Trigger(scene.clock.now, "service", "id", "/arm"), 5, 2
        )
        told += scene.later(0, call) + scene.later(3)
    begun = [answer.number for answer in told if isinstance(answer, recorder_link.RecordingStarted)]
    refused = [answer for answer in told if isinstance(answer, recorder_link.RecordingRefused)]
    assert (begun, [answer.number for answer in refused]) == ([0, 1], [2, 3, 4, 5])
    [missed] = [answer for answer in told if isinstance(answer, recorder_link.RecordingMissed)]
    assert missed.reason == refused[0].reason
    assert "recorder.per_hour" in missed.reason
    assert len(scene.closed(told)) == 2
    scene.log.close()


def fill_with_headers(scene: Scene) -> None:
    for number in range(25):
        host, definition = f"10.0.1.{number}", f"# {number} {'x' * 5000}\nstring data\n"
        stream = opened(scene.writer, "/many", host, message_definition=definition)
        stream.write(memoryview(frame(TEXT)), 1, 1)
        stream.close()


def fill_with_records(scene: Scene) -> None:
    for _record in range(150):
        denied = decision(scene.log, event="topic denied", time=scene.clock.now, reason="x" * 400)
        scene.log.record(denied)
    settle(scene.log)


def fill_with_messages(scene: Scene, number: int, size: int) -> None:
    for _message in range(number):
        scene.say(bytes(size))


FILLED: dict[str, tuple[Callable[[Scene], None], int]] = {
    "nothing": (lambda _scene: None, 0),
    "messages": (lambda scene: fill_with_messages(scene, 12, 20_000), 12),
    "empty messages": (lambda scene: fill_with_messages(scene, 3000, 0), 3000),
    "connections": (fill_with_headers, 25),
    "records": (fill_with_records, 150),
}


@pytest.mark.parametrize("filled", FILLED)
def test_no_recording_exceeds_an_eighth_of_the_disk(tmp_path: Path, filled: str) -> None:
    """All together never exceed the disk, whatever fills them, and each recording reports what did not fit."""
    scene = Scene(tmp_path, disk=8 * 100_000)
    fill, number = FILLED[filled]
    for again in range(9):
        assert scene.stream is not None
        scene.stream.close()
        scene.stream, scene.said = opened(scene.writer, "/chatter", "10.0.0.1"), 0
        order = Trigger(scene.clock.now + SECOND, "order", "", "eve")
        scene.later(1, recorder_link.RecordingRequested(1, order, 0, 5))
        fill(scene)
        told = scene.later(0.1)
        if again % 2:
            scene.begin_anew()
        [recording] = scene.closed(told + scene.later(6))
        assert recording.size <= scene.disk // 8
        assert recording.complete == (filled == "nothing"), recording.why_not
        if filled == "records":
            records = sum(topic == "/rosrv/records" for topic, _time, _data in scene.bag(recording))
            assert (0 < records < number, "did not fit" in recording.why_not) == (True, True)
        elif filled != "nothing":
            [topic] = recording.topics
            assert (topic.messages + topic.missed, topic.missed > 0) == (number, True)
            assert "an eighth of recorder.disk" in recording.why_not
            assert recording.size > 0.75 * scene.disk // 8
        assert sum(path.stat().st_size for path in scene.folder.glob("*/recording.bag")) <= scene.disk
    scene.log.close()


def test_excluded_topics_are_listed_with_the_reason(scene: Scene) -> None:
    named = scene.writer.open("/camera", "10.0.0.1", HEADER | {LEFT_OUT: NAMED})
    assert named is not None
    ExcludedStream(named).write(memoryview(frame(TEXT)), 1, 1)
    scene.happen()
    assert not scene.closed(scene.later(1))
    [recording] = scene.closed(scene.later(10))
    assert recording.complete
    assert [(row.topic, row.host, row.why) for row in recording.left_out] == [("/camera", "10.0.0.1", NAMED)]
    claimed = scene.writer.open("/front", "10.0.0.9", HEADER | {LEFT_OUT: "its publisher says so"})
    assert claimed is not None
    for number in range(1, 4):
        ExcludedStream(claimed).write(memoryview(frame(TEXT)), 1, number)
    scene.happen()
    assert not scene.closed(scene.later(1))
    scene.begin_anew()
    [recording] = scene.closed(scene.later(10))
    assert (recording.complete, "/front" in recording.why_not) == (False, True)
    assert {row.topic for row in recording.left_out} >= {"/front"}
    own = {"/chatter", "/rosrv/records", "/rosrv/log"}
    assert {name for name, _time, _data in scene.bag(recording)} <= own


def test_messages_that_had_left_the_memory_are_reported(scene: Scene) -> None:
    for _message in range(30):
        scene.say(bytes(100_000))
    scene.happen()
    scene.later(0.1)
    [recording] = scene.closed(scene.later(6))
    assert not recording.complete
    assert "was no longer in recorder.memory: /chatter" in recording.why_not


def test_the_next_recorder_continues_after_a_crash(scene: Scene) -> None:
    scene.happen()
    scene.later(0.1)
    [part] = scene.folder.iterdir()
    scene.say()
    with (part / "recording.bag").open("ab") as bag:
        bag.write(b"torn")
    scene.begin_anew()
    scene.later(1)
    scene.say()
    [recording] = scene.closed(scene.later(6))
    assert part.name == f".{recording.id}.part"
    assert recording.complete
    assert len(recording.triggers) == 1
    assert [data for name, _time, data in scene.bag(recording) if name == "/chatter"] == [TEXT, TEXT, TEXT]


def test_a_restart_of_the_appliance_ends_a_recording(scene: Scene) -> None:
    """The new recorder's memory is empty, so the written part is marked as incomplete. An empty part is removed."""
    scene.happen()
    scene.later(0.1)
    (scene.folder / f".{'a' * 20}.part").mkdir()
    scene.born = scene.clock.now = BEGAN + 100 * SECOND
    scene.begin_anew()
    [recording] = scene.closed(scene.later(0))
    assert (recording.complete, recording.why_not) == (False, "the appliance stopped during the recording")
    assert [data for name, _time, data in scene.bag(recording) if name == "/chatter"] == [TEXT]
    assert [path.name for path in scene.folder.iterdir()] == [recording.id]


@pytest.mark.parametrize("begun", [False, True])
def test_a_recording_that_the_end_of_the_appliance_prevented_is_reported(scene: Scene, begun: bool) -> None:
    made, prevented = "a" * 20, "b" * 20
    planned(scene, made, "10.0.0.9")
    scene.later(0.1)
    planned(scene, prevented, "robot")
    if begun:
        scene.later(0.1)
        (scene.folder / f".{prevented}.part" / "progress").write_bytes(b"")  # as a power cut may leave it
    scene.born = scene.clock.now = BEGAN + 3 * SECOND
    scene.begin_anew()
    told = scene.later(0.1, recorder_link.RecordingsAsked())
    assert {recording.id for recording in scene.closed(told)} == {made}
    missed = [answer for answer in told if isinstance(answer, recorder_link.RecordingMissed)]
    assert [(one.planned, one.reason) for one in missed] == [
        (prevented, "the appliance stopped before it was written")
    ]
    scene.happen("recording missed", detail={"recording": prevented})
    told = scene.later(1, recorder_link.RecordingsAsked()) + scene.later(10)
    assert not any(isinstance(answer, recorder_link.RecordingMissed) for answer in told)


def test_a_late_recorder_handles_earlier_triggers(scene: Scene) -> None:
    scene.happen()
    scene.clock.now += 3 * SECOND
    scene.begin_anew()
    scene.later(0.1)
    [recording] = scene.closed(scene.later(6))
    assert recording.triggers[0].time == BEGAN
    scene.begin_anew()
    scene.later(0.1)
    assert not scene.closed(scene.later(60))


def test_a_recording_is_reported_until_it_is_noted(scene: Scene) -> None:
    scene.happen()
    [opened] = [
        said.recording for said in scene.later(0.1) if isinstance(said, recorder_link.RecordingOpened)
    ]
    assert recorder_link.RecordingsStated([], [opened]) in scene.later(0, recorder_link.RecordingsAsked())
    [recording] = scene.closed(scene.later(6))
    assert (opened.id, opened.began, opened.trigger) == (recording.id, recording.began, recording.triggers[0])
    assert scene.closed(scene.later(0, recorder_link.RecordingsAsked())) == [recording]
    answers = scene.later(0, recorder_link.RecordingNoted(recording.id), recorder_link.RecordingsAsked())
    assert scene.closed(answers) == []
    assert recorder_link.RecordingsStated([recording]) in answers
    remove = recorder_link.RecordingRemovalWanted(3, recording.id, "eve")
    assert scene.later(0, remove) == [recorder_link.RecordingRemoved(3, recording, "eve", "")]
    [refused] = scene.later(0, remove)
    assert isinstance(refused, recorder_link.RecordingRefused)
    assert refused.unknown


def test_revisions_are_the_last_that_control_sent(scene: Scene) -> None:
    scene.happen()
    assert recorder_link.RevisionsWanted() in scene.later(0.1)
    scene.later(0, recorder_link.RevisionsStated(4, 2))
    [recording] = scene.closed(scene.later(6))
    assert (recording.policy, recording.monitors) == (4, 2)


def test_a_header_that_is_not_text_is_recorded(scene: Scene) -> None:
    hostile = {"message_definition": "# caf\udce9\nstring data\n", "latching": "x", "type": "t" * 10_000}
    scene.stream = scene.writer.open("/cafe", "10.0.0.2", HEADER | hostile)
    scene.said = 0
    scene.say()
    scene.happen()
    scene.later(0.1)
    scene.begin_anew()
    scene.later(1)
    [recording] = scene.closed(scene.later(6))
    assert sorted(topic.topic for topic in recording.topics) == ["/cafe", "/chatter"]
    assert {topic for topic, _time, _data in scene.bag(recording)} >= {"/cafe", "/chatter"}
    with Reader(scene.folder / recording.id / "recording.bag") as reader:
        [cafe] = [connection for connection in reader.connections if connection.topic == "/cafe"]
    assert cafe.msgdef.data == "# caf\ufffd\nstring data\n"


def test_a_recorder_killed_after_the_last_write_loses_nothing(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.happen()
    scene.later(0.1)

    def killed(_store: RecordingStore, _recording: Recording) -> None:
        raise SystemExit

    monkeypatch.setattr(RecordingStore, "keep", killed)
    with pytest.raises(SystemExit):
        scene.later(6)
    monkeypatch.undo()
    [part] = scene.folder.iterdir()
    scene.born = scene.clock.now = BEGAN + 100 * SECOND
    scene.recorder = scene.make_recorder()
    [recording] = scene.closed(scene.later(0))
    assert part.name == f".{recording.id}.part"
    assert [data for name, _time, data in scene.bag(recording) if name == "/chatter"] == [TEXT]


def test_a_clock_that_is_set_back_ends_one_recording_only(scene: Scene) -> None:
    scene.happen()
    scene.later(0.1)
    scene.set_clock(-100)
    [cut] = scene.closed(scene.later(0))
    assert not cut.complete
    assert cut.why_not == "the clock was set, or the machine was suspended, during the recording"
    assert cut.began <= cut.ended
    scene.say()
    scene.happen()
    scene.later(0.1)
    [recording] = scene.closed(scene.later(6))
    assert [data for name, _time, data in scene.bag(recording) if name == "/chatter"] == [TEXT]
    assert recording.ended == scene.clock.now - int(1.1 * SECOND)


@pytest.mark.parametrize("seconds", [-600, -1, -0.2, 0.2, 1, 3600])
def test_no_recording_has_times_before_and_after_the_clock_was_set(tmp_path: Path, seconds: float) -> None:
    """Otherwise a replay takes the step for a silence of that length."""
    for at in (0, 3, 4, 5, 6, 7, 20, 21, 22, 45):
        (folder := tmp_path / f"{at}").mkdir()
        scene = Scene(folder)
        told: list[messages.Message] = []
        for tick in range(60):
            scene.clock.now += SECOND // 20
            if tick == at:
                scene.set_clock(seconds)
            scene.say((scene.clock.now - scene.set).to_bytes(8, "little"))
            if tick in (5, 40):
                scene.happen()
            if tick % 4 == 0:
                told += scene.later(0)
            if tick == 30:
                scene.begin_anew()
        memory = recorder_link.MemoryWanted(1, Trigger(scene.clock.now, "order", "", "eve"), 0, 1 << 62)
        told += scene.later(0, memory)
        lent = [answer.recording for answer in told if isinstance(answer, recorder_link.MemoryLent)]
        recordings = [*lent, *scene.closed(told + scene.later(6) + scene.later(6))]
        found = set[bytes]()
        for recording in recordings:
            rows = [row for row in scene.bag(recording) if row[0] == "/chatter"]
            steps = {time - int.from_bytes(data, "little") for _topic, time, data in rows}
            assert len(steps) == 1
            found.update(data for _topic, _time, data in rows)
            assert all(recording.began <= time <= recording.ended for _topic, time, _data in rows)
        assert (len(lent), len(recordings) >= 2, len(found) >= 40) == (1, True, True)
        assert ["the clock was set" in one.why_not for one in recordings].count(True) == (
            at > 8
        )  # it begins at 8
        scene.log.close()


def test_the_number_of_headers_is_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.features.recorder.recording._MAX_HEADERS", 20_000)
    scene.happen()
    scene.later(0.1)
    quiet = scene.stream
    for number in range(30):
        definition = f"# {number} {'x' * 5000}\nstring data\n"
        scene.stream = opened(scene.writer, "/many", "10.0.0.2", message_definition=definition)
        scene.said = 0
        scene.say()
        scene.stream.close()
        scene.later(0.1)
    scene.stream, scene.said = quiet, 1
    scene.say()
    [recording] = scene.closed(scene.later(6))
    assert recording.why_not == "27 messages of too many different connections"
    assert {topic.topic: topic.messages for topic in recording.topics} == {"/chatter": 2, "/many": 3}
    assert recording.size < 100_000
