"""The messages of one read, on a topic with a rank."""

import itertools
import struct
from typing import get_args

import pytest

from appliance.channel.messages.relay_link import RankPlace, RankStanding
from appliance.relay.connections.ranked_publication import RankedPublication
from appliance.relay.ranked_topic import RankedTopic
from appliance.relay.transport.frames import Batch
from appliance.relay.velocity_zero import LAYOUTS
from tests.unit.relay.connections.test_relayed_topic import HEADER, Story, batch
from tests.unit.relay.test_ranked_topic import settle

TWIST = "geometry_msgs/Twist"
VELOCITY = {**HEADER, "type": TWIST, "md5sum": LAYOUTS[TWIST].md5sum}
ZERO, GO = bytes(48), struct.pack("<6d", 1, 0, 0, 0, 0, 0)
PLACE = RankPlace(0, 0.3, standing="free")


class Pair:
    """A gamepad and a planner, whose relay has listened long ago."""

    def __init__(self) -> None:
        self.pad, self.planner = Story("/cmd_vel"), Story("/cmd_vel")
        self.ranked = RankedTopic(PLACE, 0.0, lambda _driver: self.planner.topic.hush())
        for rank, (key, story) in enumerate((("pad", self.pad), ("planner", self.planner))):
            self.ranked.place(key, rank, 0.3)
            story.topic.give_rank(RankedPublication(self.ranked, key))
            story.topic.upstream_opened(VELOCITY)
        settle(self.ranked, 0.0)


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_a_batch_passes_from_the_first_motion_on(pair: Pair) -> None:
    """The zeros of a gamepad at rest do not; the zero that follows does."""
    member = pair.pad.join()
    pair.pad.receive(batch(ZERO, ZERO, GO, ZERO))
    assert member.received == bytes(batch(GO, ZERO).view)
    pair.pad.receive(batch(ZERO))
    assert member.received == bytes(batch(GO, ZERO, ZERO).view)


def test_only_the_driver_is_heard(pair: Pair) -> None:
    """The lower one stays connected, and nothing of it is repeated to a later subscriber."""
    low = pair.planner.join()
    pair.planner.receive(batch(GO))
    pair.pad.receive(batch(GO))
    pair.planner.receive(batch(GO, GO))
    assert low.received == bytes(batch(GO).view)
    assert not low.was_cut
    assert pair.planner.join("/late").received == b""


def test_a_topic_with_a_rank_is_not_left_to_the_pump(pair: Pair) -> None:
    """And one without a rank is, as before."""
    member = pair.pad.join()
    member.descriptor = 5
    pair.pad.now += 10
    pair.pad.topic.tidy()
    assert pair.pad.topic.simple() is None
    pair.pad.topic.give_rank(None)
    assert pair.pad.topic.simple() == ([5], None)


def test_a_message_that_waits_for_monitors_does_not_pass_after_a_hand_over(pair: Pair) -> None:
    """It was taken while the planner drove."""
    taken: list[int] = []

    def leave_the_rest(frames: Batch) -> Batch:
        taken.append(frames.messages)
        frames.left = frames.messages - 1
        return frames.head(1)

    low = pair.planner.join()
    pair.planner.topic.monitor(leave_the_rest, wanted=True)
    rest = pair.planner.topic.received(batch(GO, GO), 100.0)
    assert rest is not None
    pair.pad.receive(batch(GO))
    assert pair.planner.topic.go_on(rest, 100.0) is None
    assert (taken, low.received) == ([2], bytes(batch(GO).view))


def test_a_latched_message_never_passes() -> None:
    """Not even that of a new publisher: it may have been sent before a hand-back."""
    story = Story("/cmd_vel", replayed=lambda _topic, _body: False)
    ranked = RankedTopic(PLACE, 0.0, lambda _driver: None)
    ranked.place("pad", 0, 0.3)
    settle(ranked, 0.0)
    story.topic.give_rank(RankedPublication(ranked, "pad"))
    member = story.join()
    story.topic.upstream_opened({**VELOCITY, "latching": "1"})
    story.receive(batch(GO))
    assert (member.received, ranked.driver.standing) == (b"", "free")
    story.now += 0.2
    story.receive(batch(GO))
    assert member.received == bytes(batch(GO).view)


def test_a_publisher_with_a_rank_is_connected_without_a_subscriber(pair: Pair) -> None:
    """Its motion counts even then."""
    assert pair.pad.upstream.asked[0] == "want"
    assert "spare" not in pair.pad.upstream.asked
    pair.pad.topic.give_rank(None)
    assert pair.pad.upstream.asked[-1] == "spare"


def test_a_connection_that_ends_after_a_motion_is_a_loss(pair: Pair) -> None:
    """At once, not after the silence."""
    pair.pad.receive(batch(GO))
    pair.pad.topic.upstream_closed()
    assert pair.ranked.driver.standing == "lost"


@pytest.mark.parametrize("standing", get_args(RankStanding))
@pytest.mark.parametrize("driver", ["pad", "planner", ""])
@pytest.mark.parametrize("key", ["pad", "planner"])
@pytest.mark.parametrize("listens", [True, False])
def test_messages_of_one_read_pass_as_in_reads_of_their_own(
    standing: RankStanding, driver: str, key: str, listens: bool
) -> None:
    """No further motion passes, and the last message is the same; a zero before a dropped motion may be lost."""

    def passed(*reads: tuple[bytes, ...]) -> list[bytes]:
        place = RankPlace(0, 0.3, driver, int(driver == "planner"), standing)
        ranked = RankedTopic(place, 0.0, lambda _driver: None)
        ranked.place("pad", 0, 0.3)
        ranked.place("planner", 1, 0.3)
        publication = RankedPublication(ranked, key)
        publication.opened(VELOCITY, 0.0)
        now = 0.1 if listens else 10.0
        if not listens:
            settle(ranked, 0.0)
        return [bytes(one[4:]) for read in reads for one in publication.passing(batch(*read), now).frames()]

    for length in range(1, 5):
        for read in itertools.product((ZERO, GO), repeat=length):
            together, alone = passed(read), passed(*((one,) for one in read))
            assert alone[len(alone) - len(together) :] == together
            assert together or alone == passed(*((one,) for one in read[:-1]))
