import itertools
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.channel.messages import DELAY_BOUNDS, FlowLimit, LatchRefused, TopicTraffic
from appliance.channel.messages.relay_link import RankPlace
from appliance.relay.connections.message_sink import MessageSink
from appliance.relay.connections.named_subscribers import ActionServers
from appliance.relay.connections.ranked_publication import RankedPublication
from appliance.relay.connections.relayed_topic import RelayedTopic, Upstream
from appliance.relay.ranked_topic import RankedTopic
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.rate_limit import SharedRateLimit
from tests.support.relay_memory import share
from tests.support.steps import steps
from tests.unit.relay.test_ranked_topic import settle

HEADER = {"callerid": "/liar", "type": "std_msgs/String", "md5sum": "m", "latching": "0", "topic": "/x"}


def batch(*texts: bytes) -> Batch:
    frames = [struct.pack("<I", len(text)) + text for text in texts]
    data = b"".join(frames)
    return Batch(memoryview(data), len(frames), len(data) - len(frames[-1]))


class RecordedUpstream(Upstream):
    def __init__(self) -> None:
        self.asked: list[str] = []
        self.announced: tuple[list[str], str] = ([], "")
        self.paused = False

    def connect(self) -> None:
        self.asked.append("want")

    def release(self) -> None:
        self.asked.append("spare")

    def pause(self, seconds: float) -> None:
        self.asked.append(f"pause {seconds:.2f}")
        self.paused = True

    def resume(self) -> None:
        if self.paused:
            self.asked.append("resume")
        self.paused = False

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        self.announced = (sorted(names()), type_name)

    def request_latched(self) -> None:
        self.asked.append("give again")

    def greet(self, greeted: Callable[[bytes], None]) -> None:
        self.asked.append("greet")
        self.greeted = greeted


class RecordedMember:
    def __init__(self, *, fits: bool = True, caller_id: str = "/listener", host: str = "10.0.0.2") -> None:
        self.caller_id = caller_id
        self.host = host
        self.header: Mapping[str, str] = {}
        self.fields: Mapping[str, str] = {}
        self.received = b""
        self.missed = False
        self.behind_since: float | None = None
        self.was_cut = ""
        self.trimmed = 0
        self.descriptor = -1
        self._fits = fits

    def greet(self, header: Mapping[str, str]) -> bool:
        self.header = header
        return self._fits

    def admits(self, _batch: Batch) -> bool:
        return True

    def deliver(self, batch: Batch) -> int:
        self.received += bytes(batch.view)
        return 0

    def accepted(self, batch: Batch, sent: int) -> None:
        self.received += bytes(batch.view[sent:])

    @property
    def exhausted(self) -> bool:
        return False

    def trim(self) -> int:
        if self.behind_since is None:
            return 0
        self.trimmed += 1
        return 3

    def check_stall(self) -> None: ...

    def cut(self, reason: str) -> None:
        self.was_cut = reason


class Story:
    def __init__(
        self,
        topic: str = "/chatter",
        *,
        memory: int = 1 << 30,
        fresh: bool = True,
        sink: MessageSink | None = None,
        servers: Callable[[str], Collection[str]] = lambda _topic: (),
        replayed: Callable[[RelayedTopic, memoryview], bool] = lambda _topic, _body: True,
    ) -> None:
        self.now = 100.0
        self.share = share(memory)
        self.refused: list[LatchRefused] = []
        self.limited: list[tuple[str, int, int]] = []
        self.topic = RelayedTopic(
            "k",
            topic,
            "/talker",
            "10.0.0.1",
            grace=0.05,
            clock=lambda: self.now,
            share=self.share,
            fresh=fresh,
            limited=lambda *row: self.limited.append(row),
            make_room=lambda _size: None,
            refused=self.refused.append,
            sink=sink,
            servers=servers,
            replayed=replayed,
        )
        self.upstream = RecordedUpstream()
        self.topic.upstream = self.upstream

    def receive(self, frames: Batch, late: float = 0.0) -> None:
        self.topic.received(frames, self.now - late)

    def join(self, caller_id: str = "/listener") -> RecordedMember:
        member = RecordedMember(caller_id=caller_id)
        self.topic.join(member)
        return member


def connected(topic: str = "/chatter", *, latching: str = "0", **given: Any) -> tuple[Story, RecordedMember]:
    """Return a topic whose publisher came after this first subscriber."""
    story = Story(topic, **given)
    member = story.join()
    story.topic.upstream_opened(HEADER | {"latching": latching})
    return story, member


def greeting(story: Story) -> bool:
    """Let two seconds pass; return whether the publisher was asked to greet."""
    story.upstream.asked.clear()
    for _second in range(2):
        story.topic.tidy()
        story.now += 1
    story.topic.tidy()
    return "greet" in story.upstream.asked


def test_a_publisher_greets_later_subscribers_alone() -> None:
    story, judged = Story(), []
    first = story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"map"))
    assert not greeting(story), "no subscriber came later"
    story.topic.monitor(lambda batch: judged.append(batch.first) or batch, wanted=True)  # type: ignore[func-returns-value]  # the call is noted
    second, third = story.join("/second"), story.join("/third")
    assert story.upstream.asked.count("greet") == 1, "one greeting at a time"
    story.upstream.greeted(bytes(batch(b"map").view))
    assert (second.received, third.received, judged) == (bytes(batch(b"map").view), b"", [2])
    assert greeting(story)
    story.upstream.greeted(bytes(batch(b"map", b"more").view))
    assert third.received == bytes(batch(b"map", b"more").view)
    assert first.received == second.received == bytes(batch(b"map").view)
    assert not greeting(story)
    story.topic.leave(fourth := story.join("/fourth"))
    story.upstream.greeted(bytes(batch(b"late").view))
    assert (fourth.received, first.received) == (b"", bytes(batch(b"map").view))


def test_a_publisher_that_does_not_greet_is_asked_once_a_minute() -> None:
    story, _member = connected()
    asked = 0
    for _second in range(200):  # a subscriber that joins and leaves
        story.upstream.asked.clear()
        member = story.join("/other")
        story.topic.tidy()
        if "greet" in story.upstream.asked:
            asked += 1
            story.upstream.greeted(b"")
        story.topic.leave(member)
        story.now += 1
    assert asked == 5


def test_a_subscriber_that_got_no_greeting_has_a_part_in_the_next_one() -> None:
    story, _member = connected()
    late, left = story.join("/late"), story.join("/left")
    assert greeting(story)
    story.upstream.greeted(b"")
    story.topic.leave(left)
    assert greeting(story)
    story.upstream.greeted(bytes(batch(b"map").view))
    assert (late.received, left.received) == (bytes(batch(b"map").view), b"")
    assert not greeting(story)


def test_subscribers_of_a_publisher_that_does_not_greet_are_asked_for_twice() -> None:
    """Each request is a connection of two seconds."""
    story, _member = connected()
    story.join("/late")
    asked = 0
    for _second in range(600):
        story.upstream.asked.clear()
        story.topic.tidy()
        if "greet" in story.upstream.asked:
            asked += 1
            story.upstream.greeted(b"")
        story.now += 1
    assert asked == 2


@pytest.mark.parametrize("why", ["latching", "stream", "goal", "guarded", "limited", "same"])
def test_no_greeting(why: str) -> None:
    story = Story("/a/goal" if why == "goal" else "/map")
    story.join()
    story.topic.monitor(lambda batch: batch, wanted=False, guarded=why == "guarded")
    if why == "limited":
        story.topic.flow.set(SharedRateLimit(FlowLimit(messages=2), story.now).of(""), None)
    story.topic.upstream_opened(HEADER | ({"latching": "1"} if why == "latching" else {}))
    greeting(story)
    late = story.join("/late")
    if why == "stream":
        story.upstream.asked.clear()
        for _message in range(60):
            story.receive(batch(b"1"))
            story.now += 0.05
            late = story.join("/late")
            if not _message % 20:
                story.topic.tidy()
    if why == "same":  # a message to all, which comes over both connections
        story.receive(batch(b"1"))
        story.upstream.greeted(bytes(batch(b"1").view))
        assert late.received == bytes(batch(b"1").view)
    else:
        assert "greet" not in story.upstream.asked


def test_subscribers_wait_for_the_publishers_header_and_get_it_with_the_true_name() -> None:
    story = Story()
    member = story.join()
    assert (story.upstream.asked, member.header) == (["want"], {})
    story.topic.upstream_opened(HEADER)
    assert member.header == HEADER | {"callerid": "/talker", "topic": "/chatter"}


def test_messages_beyond_a_limit_reach_no_monitor_or_subscriber() -> None:
    story, judged = Story(), []
    member = story.join()
    story.topic.monitor(lambda batch: judged.append(batch.first) or batch, wanted=True)  # type: ignore[func-returns-value]  # the call is noted
    story.topic.flow.set(SharedRateLimit(FlowLimit(messages=2), story.now).of(""), None)
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    for number in range(4):
        story.receive(batch(b"%d" % number))
    assert (member.received, judged) == (bytes(batch(b"0").view), [1])
    assert story.limited == [("publisher", 1, 5)] * 3
    story.topic.tidy()
    assert judged == [1]
    story.now += 1
    story.topic.tidy()
    assert (member.received, judged) == (bytes(batch(b"0", b"3").view), [1, 4])
    assert story.join().received == bytes(batch(b"3").view)
    story.receive(batch(b"4"))  # the delayed message used up the limit
    assert member.received == bytes(batch(b"0", b"3").view)


def test_a_subscriber_whose_limit_kept_the_latched_message_from_it_gets_it_later() -> None:
    story, member = connected(latching="1")
    story.receive(batch(b"1"))
    story.topic.tidy()
    assert member.received == bytes(batch(b"1").view)
    member.missed = True
    story.topic.tidy()
    assert member.received == bytes(batch(b"1", b"1").view)


def test_a_withheld_topic_reaches_only_other_hosts() -> None:
    """Each message is decided alone, even within a batch. The pump leaves the topic to Python."""
    story, hidden, judged = Story(), [False], []

    def through(one: Batch) -> Batch:
        judged.append(one.messages)
        hidden[0] = bytes(one.view).endswith(b"private")
        return one

    tablet, robot = story.join(), RecordedMember(host="10.0.0.3")
    story.topic.join(robot)
    story.topic.monitor(through, wanted=True)
    story.topic.withhold(lambda host: hidden[0] and host == tablet.host)
    story.topic.upstream_opened(HEADER)
    rest: Batch | None = batch(b"1", b"private", b"2")
    while rest is not None:
        rest = story.topic.received(rest, story.now)
    assert tablet.received == bytes(batch(b"1", b"2").view)
    assert robot.received == bytes(batch(b"1", b"private", b"2").view)
    assert (judged, story.topic.simple()) == ([1, 1, 1], None)


def test_a_withheld_latched_message_is_given_when_the_topic_is_free() -> None:
    """A subscriber that came in the meantime gets it as well. Other hosts get it at once, and each host once."""
    story, hidden = Story(), [True]
    story.topic.withhold(lambda host: hidden[0] and host == "10.0.0.2")
    early = story.join()
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"map"))
    late, other = story.join("/late"), RecordedMember(host="10.0.0.3")
    story.topic.join(other)
    story.topic.tidy()
    assert (early.received, late.received, other.received) == (b"", b"", bytes(batch(b"map").view))
    hidden[0] = False
    for _ in range(2):
        story.topic.tidy()
        story.topic.withhold(None)
    assert early.received == late.received == other.received == bytes(batch(b"map").view)


def test_messages_are_numbered_as_they_come() -> None:
    story = Story()
    story.topic.upstream_opened(HEADER)
    batches = [batch(b"1", b"2"), batch(b"3"), batch(b"4")]
    for one in batches[:2]:
        story.receive(one)
    story.topic.upstream_closed()
    story.topic.upstream_opened(HEADER)
    story.receive(batches[2])
    assert [one.first for one in batches] == [1, 3, 4]


def test_the_publisher_is_let_go_with_the_last_subscriber() -> None:
    story = Story()
    first, second = story.join(), story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.leave(first)
    assert "spare" not in story.upstream.asked
    story.topic.leave(second)
    assert story.upstream.asked[-1] == "spare"


@pytest.mark.parametrize("ends", [*itertools.product((False, True), repeat=3)])
@pytest.mark.parametrize("held", [*itertools.product((False, True), repeat=4)])
def test_a_latched_message_is_asked_for_again_if_the_last_one_was_held_back(
    held: tuple[bool, ...], ends: tuple[bool, ...]
) -> None:
    """The publisher sends four messages, of which monitors hold back some; a batch ends after some of them."""

    def through(frames: Batch) -> Batch | None:
        parts = [frames.tail(frames.messages - n).head(1) for n in range(frames.messages)]
        texts = [bytes(part.view[4:]) for part in parts]
        passing = [text for text in texts if not (hold and text == b"held")]
        return batch(*passing) if passing else None

    story, hold = Story("/map"), [True]
    story.topic.monitor(through, wanted=True)
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    texts = [b"held" if one else b"%d" % number for number, one in enumerate(held)]
    for _, part in itertools.groupby(range(4), lambda number: sum(ends[:number])):
        rest: Batch | None = batch(*(texts[number] for number in part))
        while rest is not None:
            rest = story.topic.received(rest, story.now)
    passed = [text for text in texts if text != b"held"][-1:]
    assert story.topic.lacks_latched == held[-1]
    assert story.join("/early").received == bytes(batch(*passed).view if passed else b"")
    if held[-1]:
        story.topic.upstream_closed(repeats=True)
        assert story.join("/between").received == bytes(batch(*passed).view if passed else b"")
        hold.clear()
        story.topic.upstream_opened(HEADER | {"latching": "1"})
        story.receive(batch(texts[-1]))
        assert not story.topic.lacks_latched
        assert story.join("/late").received == bytes(batch(texts[-1]).view)


def test_messages_of_monitors_are_counted() -> None:
    story, _member = connected()
    story.topic.traffic()
    story.topic.published(batch(b"stop"))
    row = story.topic.traffic()
    assert row is not None and (row.messages, row.bytes) == (1, 8)


class _Recorder:
    keeps = True

    def __init__(self) -> None:
        self.written = b""

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> "_Recorder":
        return self

    def write(
        self, frames: memoryview, messages: int, first: int, judged: int = 0, *, carried: bool = True
    ) -> None:
        self.written += bytes(frames)

    def close(self) -> None: ...


def test_a_sink_gets_messages_as_they_came_although_a_monitor_changes_them_in_place() -> None:
    recorder = _Recorder()
    story = Story(sink=recorder)

    def censor(batch: Batch) -> Batch:
        batch.view[4:] = b"*" * len(batch.view[4:])
        return batch

    story.topic.monitor(censor, wanted=True)
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(Batch(memoryview(bytearray(batch(b"secret").view)), 1, None))
    assert member.received == bytes(batch(b"******").view)
    assert recorder.written == bytes(batch(b"secret").view)


def test_a_topic_that_keeps_first_messages_does_not_go_past_python() -> None:
    story = Story()
    story.topic.monitor(None, wanted=True)
    story.topic.upstream_opened(HEADER)
    assert story.topic.simple() is None
    story.now += 10
    story.topic.tidy()
    assert story.topic.simple() is not None


STOP, FORWARD, BACK = (bytes(batch(text).view) for text in (b"stop", b"forward", b"back"))


@pytest.mark.parametrize("latching", ["0", "1"])
def test_a_guards_stop_follows_the_motions_before_it_on_their_connection(latching: str) -> None:
    """It is sent once. Until the next message, a base that reconnects gets only the stop."""
    story = monitored(latching=latching)
    early = story.join()
    story.receive(batch(b"forward"))
    for _ in range(3):
        story.topic.supersede(b"stop")
        story.topic.tidy()
    late = story.join()
    assert (early.received, late.received) == (FORWARD + STOP, STOP)
    story.receive(batch(b"back"))
    assert (late.received, story.join().received) == (STOP + BACK, BACK if latching == "1" else b"")
    story.topic.supersede(b"stop")
    assert late.received == STOP + BACK + STOP


def test_a_command_of_a_monitor_is_not_repeated_as_a_stop() -> None:
    """The next stop is sent again, and subscribers that connect later also get it."""
    story = monitored()
    base = story.join()
    story.topic.supersede(b"stop")
    story.topic.supersede(None)
    assert story.join().received == b""
    story.topic.supersede(b"stop")
    assert (base.received, story.join().received) == (STOP + STOP, STOP)


@pytest.mark.parametrize("latching", ["0", "1"])
def test_a_guards_stop_outlasts_the_connection_of_its_publisher(latching: str) -> None:
    """A base that reconnects after a cut gets it, unless the publisher returns with another type."""
    story = monitored(latching=latching)
    base = story.join()
    story.receive(batch(b"forward"))
    story.topic.upstream_closed()
    story.topic.supersede(b"stop")
    assert base.received == FORWARD + STOP
    story.topic.leave(base)
    assert story.join().received == STOP
    story.topic.upstream_opened(HEADER | {"latching": latching})
    assert story.join().received == STOP
    story.topic.upstream_closed()
    story.topic.upstream_opened(HEADER | {"latching": latching, "md5sum": "other"})
    assert story.join().received == b""


@pytest.mark.parametrize("latching", ["0", "1"])
def test_a_cancelled_goal_is_not_repeated(latching: str) -> None:
    story = monitored(latching=latching)
    story.receive(batch(b"goal"))
    story.topic.supersede(None)
    assert story.join().received == b""


def test_a_stop_that_a_subscribers_limit_kept_from_it_comes_later() -> None:
    story = monitored()
    base = story.join()
    story.receive(batch(b"forward"))
    story.topic.supersede(b"stop")
    base.missed = True
    story.topic.tidy()
    assert base.received == bytes(batch(b"forward", b"stop", b"stop").view)


def test_a_stop_for_which_there_is_no_memory_is_sent_and_not_repeated() -> None:
    story, base = connected(memory=100)
    story.share.add(100)
    story.receive(batch(b"forward"))
    story.topic.supersede(b"stop")
    assert (base.received, story.join().received) == (bytes(batch(b"forward", b"stop").view), b"")
    story.receive(batch(b"back"))
    story.share.add(-100)
    story.join()
    assert "give again" not in story.upstream.asked


@pytest.mark.parametrize("topic", ["/cmd_vel", "/arm/goal", "/map"])
def test_a_command_that_was_not_kept_is_not_asked_for(topic: str) -> None:
    """Not if a guard dropped it, nor if it had no memory: it would begin a motion later. A map is asked for."""
    story = Story(topic, memory=100)
    story.topic.monitor(lambda _batch: None, wanted=True, guarded=topic == "/cmd_vel")
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"dropped"))
    story.topic.monitor(None, wanted=False)  # the guard is off
    assert story.topic.lacks_latched == (topic == "/map")
    story.share.add(100)
    story.receive(batch(b"not kept"))
    story.share.add(-100)
    story.join()
    assert ("greet" in story.upstream.asked) == (topic == "/map")


def monitored(*, latching: str = "0", fresh: bool = True) -> Story:
    story = Story(fresh=fresh)
    story.topic.monitor(lambda batch: batch, wanted=True)
    story.topic.upstream_opened(HEADER | {"latching": latching})
    return story


def test_the_first_messages_of_a_publisher_are_replayed() -> None:
    story = monitored()
    story.receive(batch(b"0"))
    story.now += 0.2
    story.receive(batch(b"1"))
    first = story.join()
    assert first.received == bytes(batch(b"0", b"1").view)
    second = story.join("/second")
    assert second.received == bytes(batch(b"0", b"1").view)
    story.topic.leave(second)
    assert story.join("/second").received == b""
    story.now += 0.9
    assert story.join("/third").received == b""
    story.topic.tidy()
    assert story.share.used == 0


@pytest.mark.parametrize("seconds", [0.3, 2.0, 60.0])
def test_a_later_subscriber_gets_no_old_messages(seconds: float) -> None:
    story = monitored()
    for _ in range(int(seconds * 20) + 1):
        story.receive(batch(b"old"))
        story.now += 0.05
    assert story.share.used == 0
    member = story.join()
    story.receive(batch(b"new"))
    assert member.received == bytes(batch(b"new").view)


@pytest.mark.parametrize("case", ["relay restarted", "connected again", "monitor loaded late", "came back"])
def test_a_publisher_that_has_been_there_said_nothing_first(case: str) -> None:
    """Only a publisher that has just appeared may have sent its first messages because of the monitor."""
    story = monitored(fresh=case != "relay restarted") if case != "monitor loaded late" else Story()
    if case == "connected again":
        story.topic.upstream_closed()
        story.topic.upstream_opened(HEADER)
    elif case == "monitor loaded late":
        story.now += 6
        story.topic.monitor(lambda batch: batch, wanted=True)
        story.topic.upstream_opened(HEADER)
    elif case == "came back":
        member = story.join()
        story.now += 6
        story.topic.leave(member)
    story.receive(batch(b"1"))
    assert story.join("/next").received == b""


def test_first_messages_without_subscribers_are_dropped_soon() -> None:
    story = monitored()
    story.receive(batch(b"1"))
    story.topic.tidy()
    assert story.share.used > 0
    story.now += 1.5
    story.topic.tidy()
    assert story.share.used == 0


def test_a_latched_message_beyond_the_quota_is_not_kept() -> None:
    story, early = connected(memory=100, latching="1")
    story.share.add(50)
    for _ in range(2):
        story.receive(batch(bytes(60)))
    assert early.received == 2 * bytes(batch(bytes(60)).view)
    assert story.refused == [LatchRefused("k", "/chatter", 64)]
    late = story.join()
    assert (late.received, story.share.used) == (b"", 50)
    story.topic.latch.repeat()
    assert len(story.refused) == 2
    answered(story, batch(bytes(60)))
    assert late.received == bytes(batch(bytes(60)).view)
    assert early.received == 2 * late.received
    story.share.add(-50)
    story.receive(batch(bytes(60)))
    assert story.share.used == 64
    assert story.join().received == bytes(batch(bytes(60)).view)
    story.topic.latch.repeat()
    assert len(story.refused) == 2


def answered(story: Story, latched: Batch) -> None:
    """Let three seconds pass, in which each request for a greeting brings the latched messages."""
    for _second in range(3):
        if "greet" in story.upstream.asked:
            story.upstream.asked.clear()
            story.upstream.greeted(bytes(latched.view))
        story.now += 1
        story.topic.tidy()


def texts(frames: bytes) -> list[bytes]:
    return [bytes(frame[4:]) for frame in Batch(memoryview(frames), 0, None).frames()]


WAYS = ["plain", "monitored", "masked", "missed", "tap", "relay restarted"]


@pytest.mark.parametrize(
    ("first", "later", "latched"),
    [
        (["one"], [], ["one"]),
        (["one", "two", "three"], [], ["one", "two", "three"]),
        (["same", "same"], [], ["same", "same"]),
        (["old", "other"], ["new"], ["new", "other"]),
        (["one"], ["two", "three"], ["one", "two", "three"]),
        (["map"], ["not latched"], ["map"]),
    ],
)
@pytest.mark.parametrize("way", WAYS)
def test_each_subscriber_gets_what_each_publisher_of_a_process_has_latched(
    way: str, first: list[str], later: list[str], latched: list[str]
) -> None:
    """It also gets the last message that was sent. Monitors judge each message once."""
    story, judged, hidden, shown = Story(fresh=way != "relay restarted"), list[Batch](), [True], list[bytes]()
    early = story.join()
    if way == "monitored":
        story.topic.leave(early)
        story.topic.monitor(lambda one: judged.append(one) or one, wanted=True)  # type: ignore[func-returns-value]  # the call is noted
    elif way == "masked":
        story.topic.withhold(lambda _host: hidden[0])
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    rest: Batch | None = batch(*(text.encode() for text in first))
    while rest is not None:
        rest = story.topic.received(rest, story.now)
    for text in later:
        story.receive(batch(text.encode()))
    latched_now = batch(*(text.encode() for text in latched))
    hidden[0] = False
    if way == "tap":
        story.topic.tap(lambda one: shown.append(bytes(one.view)), latched=True)
    elif way == "missed":
        early.received, early.missed = b"", True
        story.topic.tidy()
    elif way == "masked":
        story.topic.tidy()
    else:
        early = story.join("/late")
    answered(story, latched_now)
    got = texts(b"".join(shown) if way == "tap" else early.received)
    last = [text.encode() for text in (first + later)[-1:] if text not in latched]
    assert sorted(got) == sorted([*texts(bytes(latched_now.view)), *last])
    assert len(judged) == (len(first + later) if way == "monitored" else 0)


def test_a_newer_message_is_not_followed_by_an_older_one_that_was_latched() -> None:
    """The publisher is asked again, at most once a second."""
    story = Story()
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"old", b"other"))
    late = story.join()
    story.receive(batch(b"new"))
    story.upstream.greeted(bytes(batch(b"old", b"other").view))
    assert texts(late.received) == [b"other", b"new"]
    story.join("/again")
    assert story.upstream.asked.count("greet") == 1
    story.now += 1
    story.topic.tidy()
    assert story.upstream.asked.count("greet") == 2
    story.upstream.greeted(bytes(batch(b"new", b"other").view))
    assert texts(late.received)[:2] == [b"other", b"new"] and b"old" not in texts(late.received)


@pytest.mark.parametrize("ends", ["dropped", "changed", "never seen", "later dropped"])
def test_a_latched_message_that_monitors_did_not_pass_comes_in_no_other_way(ends: str) -> None:
    story, drops = Story(), [ends == "dropped"]

    def through(one: Batch) -> Batch | None:
        if bytes(one.view[4:]) != b"secret":
            return one
        return None if drops[0] else batch(b"******") if ends == "changed" else one

    story.topic.monitor(through, wanted=True)
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"first" if ends == "never seen" else b"secret"))
    drops[0] = True
    if ends == "later dropped":
        story.receive(batch(b"secret"))
    story.receive(batch(b"fine"))
    late = story.join()
    answered(story, batch(b"secret", b"fine"))
    assert texts(late.received) == [b"fine"]


@pytest.mark.parametrize("becomes", ["guarded", "goal", "guarded during the request", "stopped"])
def test_latched_commands_are_not_requested(becomes: str) -> None:
    story = Story("/a/goal" if becomes == "goal" else "/cmd_vel")
    story.topic.monitor(lambda one: one, wanted=True, guarded=becomes == "guarded")
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    for text in (b"forward", b"back"):
        story.receive(batch(text))
    if becomes == "stopped":
        story.topic.supersede(b"stop")
    base = story.join()
    assert ("greet" in story.upstream.asked) == (becomes == "guarded during the request")
    if becomes == "guarded during the request":
        story.topic.monitor(lambda one: one, wanted=True, guarded=True)
        story.upstream.greeted(bytes(batch(b"forward", b"back").view))
    assert texts(base.received) == [b"stop" if becomes == "stopped" else b"back"]


@pytest.mark.parametrize("number", [1, 2, 3, 4])
@pytest.mark.parametrize("stop", [None, 0, 1, 3])
@pytest.mark.parametrize("reads", ["one", "each", "pairs"])
@pytest.mark.parametrize("kind", ["goal", "guarded once", "ranked"])
def test_only_stops_among_latched_commands_pass_on_a_later_connection(
    kind: str, reads: str, stop: int | None, number: int
) -> None:
    """The publisher sends them at once. After a pause, its commands are new. A recording gets each in its place."""
    recorder = _Recorder()
    story = Story(
        "/arm/goal" if kind == "goal" else "/cmd_vel",
        fresh=False,
        sink=recorder,
        replayed=lambda _topic, body: bytes(body) == b"stop",
    )
    if kind == "ranked":
        ranked = RankedTopic(RankPlace(0, 0.3, standing="free"), 0.0, lambda _driver: None)
        ranked.place("k", 0, 0.3)
        settle(ranked, 0.0)
        story.topic.give_rank(RankedPublication(ranked, "k"))
    elif kind == "guarded once":
        story.topic.monitor(lambda one: one, wanted=True, guarded=True)
        story.topic.monitor(None, wanted=False)
    base = story.join()
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    sent = [b"stop" if index == stop else b"go %d" % index for index in range(number)]
    size = {"one": number, "each": 1, "pairs": 2}[reads]
    for begin in range(0, number, size):
        story.receive(batch(*sent[begin : begin + size]))
        story.now += 0.02
    stops = [text for text in sent if text == b"stop"]
    assert (texts(base.received), texts(recorder.written)) == (stops, sent)
    story.now += 0.2
    story.receive(batch(b"new", b"newer"))
    assert texts(base.received) == [*stops, b"new", b"newer"]


def test_a_stream_of_commands_passes_a_second_after_its_connection() -> None:
    """Its publisher latches, and is never quiet."""
    story, base = connected("/arm/goal", fresh=False, replayed=lambda _topic, _body: False, latching="1")
    for number in range(60):
        story.receive(batch(b"%d" % number))
        story.now += 0.02
    assert texts(base.received)[0] in {b"50", b"51"}


def test_a_monitor_makes_nothing_up_for_a_latched_topic_or_one_that_had_a_subscriber() -> None:
    story = monitored(latching="1")
    story.receive(batch(b"1"))
    story.receive(batch(b"2"))
    assert story.join().received == bytes(batch(b"2").view)
    story = Story()
    story.topic.monitor(lambda batch: batch, wanted=True)
    story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    assert story.join().received == b""


def test_a_latched_message_is_forgotten_with_the_connection() -> None:
    story, _member = connected(latching="1")
    story.receive(batch(b"1"))
    story.receive(batch(b"12"))
    assert story.share.used == len(batch(b"12").view)
    story.topic.upstream_closed()
    assert story.join().received == b""
    assert story.share.used == 0


def test_an_old_header_is_dropped_with_its_last_subscriber() -> None:
    story, first = connected()
    story.topic.upstream_closed()
    story.topic.leave(first)
    late = story.join()
    assert late.header == {}
    story.topic.upstream_opened(HEADER | {"md5sum": "other"})
    assert late.header["md5sum"] == "other"


def test_a_subscriber_of_another_type_is_not_served() -> None:
    story = Story()
    member = RecordedMember(fits=False)
    story.topic.join(member)
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    assert member.received == b""


def test_the_publisher_is_paused_only_while_all_are_behind() -> None:
    story = Story()
    slow, quick = story.join(), story.join()
    story.topic.upstream_opened(HEADER)
    slow.behind_since = 100.0
    story.receive(batch(b"1"))
    assert (slow.trimmed, quick.trimmed) == (1, 0)
    quick.behind_since = 100.01
    story.receive(batch(b"2"))
    assert story.upstream.asked[-1] == "pause 0.06"
    story.topic.relieve()
    assert story.upstream.asked[-1] == "resume"


def test_a_stuck_subscriber_is_not_waited_for() -> None:
    story, member = connected()
    story.topic.traffic()
    member.behind_since, story.now = 99.95, 100.0  # its grace has just ended
    story.receive(batch(b"1"))
    assert member.trimmed == 1
    assert "pause" not in "".join(story.upstream.asked)
    assert story.topic.traffic() == TopicTraffic("k", "/chatter", 1, 5, 3, 1, [1] + [0] * 10, 0.0, "m")


def test_traffic_is_reported_once() -> None:
    story = Story()
    assert story.topic.traffic() is None
    story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1", b"22"))
    assert story.topic.traffic() == TopicTraffic("k", "/chatter", 2, 11, 0, 1, [2] + [0] * 10, 0.0, "m")
    story.topic.tidy()
    assert story.topic.traffic() is None


def test_delays_of_a_later_turn_are_reported_without_new_messages() -> None:
    story, _member = connected()
    story.receive(batch(b"1"))
    story.topic.traffic()
    story.topic.go_on(batch(b"3"), story.now)
    assert story.topic.traffic() == TopicTraffic("k", "/chatter", 0, 0, 0, 1, [1] + [0] * 10, 0.0, "m")


class LeavingMember(RecordedMember):
    topic: RelayedTopic

    def cut(self, reason: str) -> None:
        super().cut(reason)
        self.topic.leave(self)


@pytest.mark.parametrize("served", [True, False], ids=["served", "waiting"])
def test_a_subscriber_costs_the_same_among_thousands(served: bool) -> None:
    def work(many: int) -> int:
        story = Story()
        if served:
            story.topic.upstream_opened(HEADER)
        story.topic.upstream = Upstream()  # the topic lists its served subscribers once in a turn of the loop
        members = [LeavingMember() for _ in range(many)]

        def come_and_go() -> None:
            for member in members:
                member.topic = story.topic
                story.topic.join(member)
            story.topic.cut_all("gone")

        done = steps(come_and_go)
        assert not story.topic.members
        return done

    assert work(1000) < 15 * work(100)


def test_the_upstream_hears_who_is_served() -> None:
    scene = Story()
    topic, upstream = scene.topic, scene.upstream
    one, other = RecordedMember(caller_id="/one"), RecordedMember(caller_id="/other")
    topic.join(one)
    topic.upstream_opened({"type": "actionlib/TestActionGoal", "md5sum": "*"})
    topic.join(other)
    assert upstream.announced == (["/one", "/other"], "actionlib/TestActionGoal")
    topic.leave(one)
    assert upstream.announced == (["/other"], "actionlib/TestActionGoal")


def test_a_host_with_hundreds_of_names_is_seen_by_a_few() -> None:
    scene = Story()
    for number in range(300):
        scene.topic.join(RecordedMember(caller_id=f"/guest_{number}", host="10.0.0.66"))
    scene.topic.upstream_opened({"type": "actionlib_msgs/GoalID", "md5sum": "*"})
    scene.topic.join(RecordedMember(caller_id="/server"))
    names, _type = scene.upstream.announced
    assert len(names) == 17
    assert {"/server", "/guest_0"} < set(names)


def test_the_server_of_an_action_is_seen_first() -> None:
    servers = ActionServers()
    scene = Story("/arm/cancel", servers=servers.of)
    for number in range(20):
        scene.topic.join(RecordedMember(caller_id=f"/logger_{number}"))
    scene.topic.join(RecordedMember(caller_id="/arm_driver"))
    scene.topic.upstream_opened({"type": "actionlib_msgs/GoalID", "md5sum": "*"})
    assert "/arm_driver" not in scene.upstream.announced[0]
    assert servers.add("k", "/arm/scan", "/logger_19") == []
    assert servers.add("d", "/arm/status", "/arm_driver") == ["/arm/goal", "/arm/cancel"]
    scene.topic.announce()
    names, _type = scene.upstream.announced
    assert len(names) == 16
    assert "/arm_driver" in names
    servers.remove("d", "/arm/status")
    scene.topic.announce()
    assert "/arm_driver" not in scene.upstream.announced[0]


def test_the_delay_of_messages_is_counted_for_those_who_are_served() -> None:
    story = Story()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"), late=0.003)
    before = story.topic.traffic()
    assert before is not None
    assert before.delays == []
    story.join()
    story.topic.monitor(lambda frames: Batch(frames.view[:5], 1, 0), wanted=True)
    story.receive(batch(b"1", b"2"), late=0.003)
    story.topic.monitor(None, wanted=False)
    story.receive(batch(b"1", b"2"), late=9.0)
    row = story.topic.traffic()
    assert row is not None
    assert len(row.delays) == len(DELAY_BOUNDS) + 1
    assert {
        bound: count for bound, count in zip([*DELAY_BOUNDS, None], row.delays, strict=True) if count
    } == {
        0.005: 1,
        None: 2,
    }
    assert row.delay_seconds == pytest.approx(18.003)


@given(st.lists(st.tuples(st.sampled_from(range(10)), st.booleans()), max_size=30))
def test_an_answer_to_the_pump_holds_for_one_version(
    operations: list[tuple[int, bool]],
) -> None:
    story = Story()
    topic, members = story.topic, [story.join(f"/listener{number}") for number in range(3)]
    for number, member in enumerate(members):
        member.descriptor = 10 + number
    taps = [lambda _batch: None, lambda _batch: None]
    limit = SharedRateLimit(FlowLimit(messages=1), 0.0).of("a")
    calls: list[Callable[[bool], object]] = [
        lambda on: topic.upstream_opened(HEADER | {"latching": "01"[on]}),
        lambda _on: topic.upstream_closed(),
        lambda on: topic.join(members[0]) if on else topic.leave(members[0]),
        lambda on: topic.join(members[1]) if on else topic.leave(members[1]),
        lambda on: topic.tap(taps[0], latched=False) if on else topic.untap(taps[0]),
        lambda on: topic.monitor((lambda frames: frames) if on else None, wanted=on),
        lambda on: topic.limit(limit if on else None, None),
        lambda _on: topic.received(batch(b"x"), story.now),
        lambda _on: topic.tidy(),
        lambda on: topic.supersede(b"stop" if on else None),
    ]
    version, answer = topic.plain.number, topic.simple()
    for operation, on in operations:
        calls[operation](on)
        if topic.plain.number == version and answer is not None:
            assert topic.simple() == answer
        version, answer = topic.plain.number, topic.simple()


@pytest.mark.parametrize(
    "kind",
    ["plain", "monitored", "latched", "latched command", "driver", "other", "withheld", "limited", "tapped"],
)
def test_no_kind_of_topic_takes_many_messages_of_one_read_one_by_one(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, frames = [0], Batch.frames

    def counted(of: Batch, *after: int) -> Iterator[memoryview]:
        for frame in frames(of, *after):
            taken[0] += 1
            yield frame

    story = Story(
        "/arm/goal" if kind == "latched command" else "/chatter", replayed=lambda _topic, _body: False
    )
    story.join()
    if kind in {"driver", "other"}:
        ranked = RankedTopic(RankPlace(0, 1.0, "driver", 0, "moving"), 0.0, lambda _driver: None)
        ranked.place(kind, 0, 1.0)
        story.topic.give_rank(RankedPublication(ranked, kind))
    for _ in range(2):
        story.topic.upstream_opened(HEADER | {"latching": "01"["latched" in kind]})
    if kind == "monitored":
        story.topic.monitor(lambda batch: batch, wanted=True)
    elif kind == "withheld":
        story.topic.withhold(lambda _host: False)
    elif kind == "limited":
        story.topic.limit(SharedRateLimit(FlowLimit(messages=1), 0.0).of("a"), None)
    elif kind == "tapped":
        story.topic.tap(lambda _batch: None, latched=False)
    monkeypatch.setattr(Batch, "frames", counted)
    story.receive(Batch(memoryview(bytes(4 * 5000)), 5000, None))
    assert taken[0] <= 1000
    assert story.topic.counters.messages == 5000
