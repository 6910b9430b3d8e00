"""One relayed topic, told as a story of its publisher and its subscribers."""

import struct
from collections.abc import Mapping

import pytest

from appliance.channel.messages import DELAY_BOUNDS, TopicTraffic
from appliance.relay.frames import Batch, MemoryBudget
from appliance.relay.topic import RelayedTopic

HEADER = {"callerid": "/liar", "type": "std_msgs/String", "md5sum": "m", "latching": "0", "topic": "/x"}


def batch(*texts: bytes) -> Batch:
    """Frames with these bodies."""
    frames = [struct.pack("<I", len(text)) + text for text in texts]
    data = b"".join(frames)
    return Batch(memoryview(data), len(frames), len(data) - len(frames[-1]))


class RecordedUpstream:
    """Writes down what the topic asks of its publisher's connection."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.announced: tuple[list[str], str] = ([], "")

    def want(self) -> None:
        """Somebody is there."""
        self.asked.append("want")

    def spare(self) -> None:
        """Nobody is there."""
        self.asked.append("spare")

    def pause(self, seconds: float) -> None:
        """Do not read."""
        self.asked.append(f"pause {seconds:.2f}")

    def resume(self) -> None:
        """Read."""
        self.asked.append("resume")

    def announce(self, names: frozenset[str], type_name: str) -> None:
        """These are served."""
        self.announced = (sorted(names), type_name)


class RecordedMember:
    """A subscriber that takes everything until it is told that it is behind."""

    def __init__(self, *, fits: bool = True, caller_id: str = "/listener") -> None:
        self.caller_id = caller_id
        self.header: Mapping[str, str] = {}
        self.received = b""
        self.behind_since: float | None = None
        self.was_cut = ""
        self.trimmed = 0
        self._fits = fits

    def greet(self, header: Mapping[str, str]) -> bool:
        """Take the header."""
        self.header = header
        return self._fits

    def deliver(self, batch: Batch) -> None:
        """Take the frames."""
        self.received += bytes(batch.view)

    @property
    def full(self) -> bool:
        """As told."""
        return self.behind_since is not None

    def trim(self) -> int:
        """Pretend to drop three."""
        self.trimmed += 1
        return 3

    def cut(self, reason: str) -> None:
        """Remember why."""
        self.was_cut = reason


class Story:
    """A topic with a clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0
        self.budget = MemoryBudget(1 << 30)
        self.topic = RelayedTopic(
            "k", "/chatter", "/talker", grace=0.05, clock=lambda: self.now, budget=self.budget
        )
        self.upstream = RecordedUpstream()
        self.topic.upstream = self.upstream

    def receive(self, frames: Batch, late: float = 0.0) -> None:
        """Frames have come, so long ago."""
        self.topic.received(frames, self.now - late)

    def join(self, caller_id: str = "/listener") -> RecordedMember:
        """One more subscriber."""
        member = RecordedMember(caller_id=caller_id)
        self.topic.join(member)
        return member


def test_subscribers_wait_for_the_publishers_header_and_get_it_with_the_true_name() -> None:
    """The publisher is asked for when the first comes; the header names the node, whatever it claims."""
    story = Story()
    member = story.join()
    assert (story.upstream.asked, member.header) == (["want"], {})
    story.topic.upstream_opened(HEADER)
    assert member.header == HEADER | {"callerid": "/talker", "topic": "/chatter"}


def test_everybody_gets_every_message_in_order() -> None:
    """From the moment a subscriber is served."""
    story = Story()
    first = story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    second = story.join()
    story.receive(batch(b"2", b"3"))
    assert first.received == bytes(batch(b"1", b"2", b"3").view)
    assert second.received == bytes(batch(b"2", b"3").view)


def test_the_publisher_is_let_go_with_the_last_subscriber() -> None:
    """Not before."""
    story = Story()
    first, second = story.join(), story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.leave(first)
    assert "spare" not in story.upstream.asked
    story.topic.leave(second)
    assert story.upstream.asked[-1] == "spare"


def test_a_latched_message_is_given_once_to_each() -> None:
    """Who triggers the connection gets it from the publisher, who comes later from us; nobody twice."""
    story = Story()
    first = story.join()
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"old", b"new"))
    second = story.join()
    assert first.received == bytes(batch(b"old", b"new").view)
    assert second.received == bytes(batch(b"new").view)


def test_nothing_is_latched_for_a_publisher_that_does_not_latch() -> None:
    """A late subscriber of an ordinary topic starts with the next message."""
    story = Story()
    story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    assert story.join().received == b""


def monitored(*, latching: str = "0") -> Story:
    """A topic that a monitor wants, with its publisher connected and nobody else."""
    story = Story()
    story.topic.monitor(lambda batch: batch, wanted=True)
    story.topic.upstream_opened(HEADER | {"latching": latching})
    return story


def test_what_came_just_before_the_first_subscriber_is_not_lost_to_a_monitor() -> None:
    """A second's messages, without a gap to what follows; who comes soon after the first gets them as well."""
    story = monitored()
    for number in range(4):
        story.receive(batch(b"%d" % number))
        story.now += 0.4
    first = story.join()
    story.receive(batch(b"4"))
    assert first.received == bytes(batch(b"2", b"3", b"4").view)
    second = story.join("/second")
    assert second.received == bytes(batch(b"2", b"3", b"4").view)
    story.topic.leave(second)
    assert story.join("/second").received == b""
    story.now += 1.1
    story.receive(batch(b"5"))
    assert story.join("/third").received == b""
    assert first.received.endswith(bytes(batch(b"5").view))
    assert story.budget.used == 0


def test_what_nobody_came_for_takes_no_memory_for_long() -> None:
    """It is let go at the next look at the counters, though no other message comes."""
    story = monitored()
    story.receive(batch(b"1"))
    story.topic.tidy()
    assert story.budget.used > 0
    story.now += 1.5
    story.topic.tidy()
    assert story.budget.used == 0


def test_a_monitor_makes_nothing_up_for_a_latched_topic_or_one_that_had_a_subscriber() -> None:
    """The last message of a latched one; the next message of one whose subscriber triggered the connection."""
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


def test_who_comes_back_gets_what_it_missed_and_nothing_twice() -> None:
    """What comes while nobody is there is kept again; without monitor or publisher nothing is."""
    story = monitored()
    first = story.join()
    story.receive(batch(b"1"))
    story.topic.leave(first)
    story.now += 2
    story.receive(batch(b"3"))
    second = story.join()
    assert second.received == bytes(batch(b"3").view)
    story.topic.leave(second)
    story.receive(batch(b"4"))
    story.topic.upstream_closed()
    assert story.budget.used == 0
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"5"))
    story.topic.monitor(None, wanted=False)
    assert story.budget.used == 0


def test_a_latched_message_is_forgotten_with_the_connection() -> None:
    """The publisher sends it again when it is reached again; an old one is not made up for it."""
    story = Story()
    story.join()
    story.topic.upstream_opened(HEADER | {"latching": "1"})
    story.receive(batch(b"1"))
    story.receive(batch(b"12"))
    assert story.budget.used == len(batch(b"12").view)
    story.topic.upstream_closed()
    assert story.join().received == b""
    assert story.budget.used == 0


def test_subscribers_survive_the_loss_of_the_publisher() -> None:
    """When it is reached again, messages go on on the same connections."""
    story = Story()
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.upstream_closed()
    assert member.was_cut == ""
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    assert member.received == bytes(batch(b"1").view)


def test_a_publisher_that_comes_back_with_another_type_loses_its_subscribers() -> None:
    """They must read the new header before they read a message of it."""
    story = Story()
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.upstream_closed()
    story.topic.upstream_opened(HEADER | {"md5sum": "other"})
    assert "another type" in member.was_cut


def test_an_old_header_is_not_given_once_nobody_stands_on_it() -> None:
    """Whoever comes when the publisher is lost and its last subscriber gone waits for a new header."""
    story = Story()
    first = story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.upstream_closed()
    story.topic.leave(first)
    late = story.join()
    assert late.header == {}
    story.topic.upstream_opened(HEADER | {"md5sum": "other"})
    assert late.header["md5sum"] == "other"


def test_a_subscriber_of_another_type_is_not_served() -> None:
    """It refuses itself, and gets nothing."""
    story = Story()
    member = RecordedMember(fits=False)
    story.topic.join(member)
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1"))
    assert member.received == b""


def test_the_publisher_is_paused_only_while_all_are_behind() -> None:
    """One that keeps up is never delayed by the others; the full one drops."""
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
    """After the grace the oldest of its messages are dropped and counted, and the publisher is read."""
    story = Story()
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.traffic()
    member.behind_since, story.now = 99.0, 100.0
    story.receive(batch(b"1"))
    assert member.trimmed == 1
    assert "pause" not in "".join(story.upstream.asked)
    assert story.topic.traffic() == TopicTraffic("k", "/chatter", 1, 5, 3, 1, [1] + [0] * 10, 0.0)


def test_traffic_is_reported_once() -> None:
    """Nothing new, nothing to report."""
    story = Story()
    assert story.topic.traffic() is None
    story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1", b"22"))
    assert story.topic.traffic() == TopicTraffic("k", "/chatter", 2, 11, 0, 1, [2] + [0] * 10, 0.0)
    assert story.topic.traffic() is None


def test_a_withdrawn_topic_cuts_who_is_served_and_who_waits() -> None:
    """Each with the reason."""
    story = Story()
    served = story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.cut_all("gone")
    assert served.was_cut == "gone"
    other = Story()
    waiting = other.join()
    other.topic.cut_all("gone")
    assert waiting.was_cut == "gone"


def test_the_upstream_hears_who_is_served() -> None:
    """By name and type: when a subscriber is served, and when one leaves."""
    scene = Story()
    topic, upstream = scene.topic, scene.upstream
    one, other = RecordedMember(caller_id="/one"), RecordedMember(caller_id="/other")
    topic.join(one)
    topic.upstream_opened({"type": "actionlib/TestActionGoal", "md5sum": "*"})
    topic.join(other)
    assert upstream.announced == (["/one", "/other"], "actionlib/TestActionGoal")
    topic.leave(one)
    assert upstream.announced == (["/other"], "actionlib/TestActionGoal")


def test_the_delay_of_messages_is_counted_for_those_who_are_served() -> None:
    """From receiving a batch to handing it over, for each message that goes on; nobody served, nothing delayed."""
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
