"""A replay of a recording gives monitors the messages that they got in the relay, whatever dropped the others."""

import mmap
import struct
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import pytest

from appliance.channel.messages import FlowLimit
from appliance.features.recorder.mcap import as_mcap
from appliance.features.recorder.recorder_link import RevisionsStated
from appliance.features.recorder.recording import Progress, RecordingInProgress
from appliance.features.recorder.recording_answers import Trigger
from appliance.features.recorder.ring import SMALLEST, RingStream, RingWriter
from appliance.features.recorder.timeline import messages_around
from appliance.relay.connections.ranked_publication import RankedPublication
from appliance.relay.ranked_topic import RankedTopic
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.rate_limit import SharedRateLimit
from rosmop.recordings.recording import inputs, messages_of, open_recording
from roswire.standard import standard_definitions
from tests.unit.relay.connections.test_ranked_publication import PLACE, TWIST
from tests.unit.relay.connections.test_relayed_topic import Story, batch
from tests.unit.relay.test_ranked_topic import settle

NOW = 10**12
HEADER = {
    "type": TWIST, "md5sum": standard_definitions().md5sum(TWIST), "callerid": "/pad", "latching": "0",
    "message_definition": standard_definitions().full_text(TWIST),
}  # fmt: skip
Got = list[tuple[int, bytes]]


def sent(*numbers: int) -> Batch:
    return batch(*(struct.pack("<6d", number, 0, 0, 0, 0, 0) for number in numbers))


class Recorded:
    """A topic whose messages are recorded; its monitor leaves those of a batch after the first `most`."""

    def __init__(self, most: int = 100, topic: str = "/cmd_vel") -> None:
        self.memory = memoryview(mmap.mmap(-1, SMALLEST))
        self._ring = RingWriter(
            self.memory, topic_share=1, host_share=1, seconds=60, clock=lambda judged: judged or NOW
        )
        self.got: Got = []
        self._most, self._time = most, NOW
        self.story = Story(topic, sink=self, replayed=lambda _topic, _body: False)
        self.story.topic.monitor(self._through, wanted=True)

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> RingStream | None:
        return self._ring.open(topic, host, {**HEADER, **header})

    def _through(self, frames: Batch) -> Batch:
        self._time += 1
        head = frames.head(min(self._most, frames.messages))
        frames.left, frames.judged = frames.messages - head.messages, self._time
        self.got += [(self._time, bytes(frame[4:])) for frame in head.frames()]
        return head

    def begin(self, **header: str) -> None:
        self.story.topic.upstream_opened(HEADER | header)

    def receive(self, *numbers: int, hand_over: Callable[[], object] = lambda: None) -> None:
        rest = self.story.topic.received(sent(*numbers), self.story.now)
        hand_over()
        while rest is not None:
            rest = self.story.topic.go_on(rest, self.story.now)


def rank(driver: Recorded, *others: Recorded) -> None:
    ranked = RankedTopic(PLACE, 0.0, lambda _driver: None)
    for place, one in enumerate((driver, *others)):
        ranked.place(str(place), place, 0.3)
        one.story.topic.give_rank(RankedPublication(ranked, str(place)))
        one.begin()
    settle(ranked, 0.0)


def before_the_first_motion() -> list[Recorded]:
    driver = Recorded()
    rank(driver)
    driver.receive(0, 0, 1, 2)
    return [driver]


def a_lower_rank() -> list[Recorded]:
    driver, other = Recorded(), Recorded()
    rank(driver, other)
    driver.receive(1)
    other.receive(2, 3)
    return [driver, other]


def a_hand_over() -> list[Recorded]:
    driver, other = Recorded(), Recorded(most=1)
    rank(driver, other)
    other.receive(1, 2, 3, hand_over=lambda: driver.receive(4))
    return [driver, other]


def limited(*, own: bool, most: int) -> list[Recorded]:
    one, limit = Recorded(most), SharedRateLimit(FlowLimit(messages=2), 0.0)
    one.story.topic.limit(limit.of("a") if own else None, None if own else limit.of("a"))
    one.begin()
    one.receive(1, 2, 3, 4, 5)
    return [one]


def repeated(count: int) -> list[Recorded]:
    one = Recorded(topic="/arm/goal")
    one.begin(latching="1")
    one.story.topic.upstream_closed()
    one.begin(latching="1")
    one.receive(*range(1, count + 1))
    one.story.now += 1
    one.receive(1000)
    return [one]


WAYS: dict[str, Callable[[], list[Recorded]]] = {
    "before the first motion": before_the_first_motion,
    "a lower rank": a_lower_rank,
    "a hand-over": a_hand_over,
    "the publisher's limit": lambda: limited(own=True, most=100),
    "the topic's limit": lambda: limited(own=False, most=100),
    "a limit, and monitors that need turns": lambda: limited(own=True, most=1),
    "a repeated command": lambda: repeated(1),
    "many repeated commands": lambda: repeated(100),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_replay_has_the_messages_that_monitors_got(way: str, tmp_path: Path) -> None:
    found = WAYS[way]()
    progress = Progress("id", 0, 0, 2 * NOW, [Trigger(NOW, "order", "id", "")])
    making = RecordingInProgress(tmp_path / "made", progress, [one.memory for one in found], largest=1 << 20)
    making.step(2 * NOW)
    recording = making.finish([], RevisionsStated(1, 1))
    bag = tmp_path / "made" / "recording.bag"
    (tmp_path / "a.mcap").write_bytes(b"".join(as_mcap(bag)))
    got = sorted(entry for one in found for entry in one.got)
    counters = [one.story.topic.counters.messages for one in found]
    assert 0 < len(got) < sum(counters) == sum(row.messages for row in recording.topics)
    for path in (bag, tmp_path / "a.mcap"):
        with closing(open_recording(path)) as reader:
            wanted = {row.id for row in inputs(reader, ["*"])}
            replayed = [(time, data) for row, time, data in messages_of(reader) if row.id in wanted]
        assert sorted(replayed) == got
    judged = {struct.unpack_from("<d", data)[0] for _time, data in got}
    shown = messages_around(recording, bag, NOW).messages
    assert shown and all(one.carried is (one.fields["linear"]["x"] in judged) for one in shown)
