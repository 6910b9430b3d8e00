"""What a limit lets pass, over any time and in any pieces."""

import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from appliance.channel.messages import UNLIMITED, FlowLimit
from appliance.relay.connections.flow import BURST, Flow, Flows, PublicationFlow
from appliance.relay.connections.frames import Batch
from tests.support.relay_memory import share


def frames(*sizes: int) -> Batch:
    """Frames of so many bytes, their lengths included."""
    return Batch(
        memoryview(b"".join(struct.pack("<I", size - 4) + bytes(size - 4) for size in sizes)),
        len(sizes),
        None,
    )


def sent(flow: Flow, *batches: tuple[float, Batch]) -> int:
    """How many messages of these, each at its time, pass."""
    passed = 0
    for now, batch in batches:
        count = flow.room(batch, batch.messages, now)
        flow.take(batch.head(count))
        passed += count
    return passed


@pytest.mark.parametrize("rate", [0.1, 1.0, 5.0, 10.0, 1000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_who_keeps_to_the_limit_loses_nothing(rate: float, jitter: float) -> None:
    """Also when messages come a little too early and a little too late, and at slow rates."""
    times = [(number + jitter * (number % 2)) / rate for number in range(1000)]
    assert sent(Flow(FlowLimit(messages=rate), 0.0), *((now, frames(8)) for now in times)) == 1000


@example(rate=1.75, size=4, gaps=[(0.0, 2)])  # the bytes end where a message does
@given(
    rate=st.floats(0.5, 500),
    size=st.integers(4, 50),
    gaps=st.lists(st.tuples(st.floats(0, 0.5), st.integers(1, 30)), min_size=1, max_size=60),
)
def test_no_more_passes_than_the_rate_and_a_burst(
    rate: float, size: int, gaps: list[tuple[float, int]]
) -> None:
    """However the messages come; and what could have passed is never held back longer than that takes."""
    now, batches = 0.0, []
    for gap, count in gaps:
        now += gap
        batches.append((now, frames(*[size] * count)))
    passed = sent(Flow(FlowLimit(messages=rate), 0.0), *batches)
    assert passed <= now * rate + max(1.0, rate * BURST) + 1
    passed = sent(Flow(FlowLimit(bytes=rate * size), 0.0), *batches)
    assert passed <= now * rate + rate * BURST + 1


def test_a_message_that_is_larger_than_the_limit_passes_and_is_made_up_for() -> None:
    """A map of a megabyte over a link of 100 kB/s comes every ten seconds: it does not starve."""
    flow, map_ = Flow(FlowLimit(bytes=100_000), 0.0), frames(1_000_000)
    assert sent(flow, *((now / 2, map_) for now in range(200))) == 10


def test_the_first_of_a_batch_pass() -> None:
    """By messages and by bytes, whichever is less; frames of one length and of several."""
    flow = Flow(FlowLimit(messages=20, bytes=200), 0.0)
    assert flow.room(frames(*[4] * 30), 30, 0.0) == 10
    assert flow.room(frames(50, 30, 30, 4), 4, 0.0) == 3
    equal = Batch(memoryview((struct.pack("<I", 46) + bytes(46)) * 8), 8, None, stride=50)
    assert flow.room(equal, 8, 0.0) == 2
    assert (equal.head(2).messages, len(equal.head(2).view), equal.head(2).last) == (2, 100, 50)


def test_another_limit_counts_at_once() -> None:
    """A looser one gives no second burst, and one after none begins full."""
    flow = Flow(FlowLimit(messages=10), 0.0)
    assert sent(flow, (0.0, frames(*[4] * 9))) == 5
    flow.set(FlowLimit(messages=1000), 0.0)
    assert sent(flow, (0.0, frames(4))) == 0
    flow.set(UNLIMITED, 0.0)
    assert sent(flow, (0.0, frames(*[4] * 5000))) == 5000
    flow.set(FlowLimit(messages=10), 0.0)
    assert sent(flow, (0.0, frames(*[4] * 9))) == 5


def test_connections_with_the_same_names_have_one_flow() -> None:
    """Several of one subscriber get no more than one; what nobody holds is forgotten."""
    flows = Flows(lambda: 0.0)
    one = flows.of(FlowLimit(5), "/scan", "10.0.0.1", "/ear")
    assert one is not None
    assert flows.of(FlowLimit(7), "/scan", "10.0.0.1", "/ear") is one
    assert flows.of(FlowLimit(7), "/scan", "10.0.0.2", "/ear") is not one
    assert flows.of(UNLIMITED, "/scan", "10.0.0.3", "/ear") is None
    del one
    assert len(flows.flows) == 0


def test_a_publication_is_limited_by_itself_and_with_its_topic() -> None:
    """Who is limited is told apart; the topic's part is what others have left of it."""
    told: list[tuple[str, int, int]] = []
    together = Flow(FlowLimit(messages=8), 0.0)
    flow, other = (PublicationFlow(share(), lambda *row: told.append(row)) for _ in range(2))
    flow.set(FlowLimit(messages=6), together, 0.0)
    other.set(UNLIMITED, together, 0.0)
    passed = [one.passing(frames(*[10] * 5), 0.0, latching=False) for one in (flow, other, flow)]
    assert [one.messages if one is not None else 0 for one in passed] == [3, 1, 0]
    assert told == [("publisher", 2, 20), ("topic", 4, 40), ("publisher", 5, 50)]


def test_the_last_message_of_a_latching_publisher_comes_later() -> None:
    """When it may, with its own number, unless another one has come; it counts as memory of its host."""
    memory = share()
    flow = PublicationFlow(memory, lambda _part, _messages, _size: None)
    flow.set(FlowLimit(messages=2), None, 0.0)
    first = flow.passing(frames(10, 11, 12), 0.0, latching=True)
    assert (first.messages if first is not None else 0, memory.used) == (1, 12)
    assert flow.later(0.0) is None
    last = flow.later(0.6)
    assert last is not None
    assert (len(last.view), last.first, memory.used) == (12, 3, 0)
    assert not last.view.readonly, "monitors change it in place"
    assert flow.later(9.0) is None
    flow.passing(frames(10, 11, 12), 9.0, latching=True)
    assert flow.passing(frames(9), 99.0, latching=True) is not None
    assert (flow.later(199.0), memory.used) == (None, 0)
