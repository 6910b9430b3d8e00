import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from appliance.channel.messages import UNLIMITED, FlowLimit
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.rate_limit import (
    BURST,
    PublicationRateLimit,
    RateAllowance,
    RateLimits,
    SharedRateLimit,
)
from tests.support.relay_memory import share


def frames(*sizes: int) -> Batch:
    return Batch(
        memoryview(b"".join(struct.pack("<I", size - 4) + bytes(size - 4) for size in sizes)),
        len(sizes),
        None,
    )


def alone(limit: FlowLimit) -> RateAllowance:
    return SharedRateLimit(limit, 0.0).of("")


def sent(flow: RateAllowance, *batches: tuple[float, Batch]) -> int:
    passed = 0
    for now, batch in batches:
        count = flow.room(batch, now)
        flow.take(batch.head(count))
        passed += count
    return passed


@pytest.mark.parametrize("rate", [0.1, 1.0, 5.0, 10.0, 1000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_a_publisher_within_the_limit_loses_nothing(rate: float, jitter: float) -> None:
    times = [(number + jitter * (number % 2)) / rate for number in range(1000)]
    assert sent(alone(FlowLimit(messages=rate)), *((now, frames(8)) for now in times)) == 1000


@example(rate=1.75, size=4, gaps=[(0.0, 2)])  # the bytes end at the end of a message
@given(
    rate=st.floats(0.5, 500),
    size=st.integers(4, 50),
    gaps=st.lists(st.tuples(st.floats(0, 0.5), st.integers(1, 30)), min_size=1, max_size=60),
)
def test_no_more_passes_than_the_rate_and_a_burst(
    rate: float, size: int, gaps: list[tuple[float, int]]
) -> None:
    now, batches = 0.0, []
    for gap, count in gaps:
        now += gap
        batches.append((now, frames(*[size] * count)))
    passed = sent(alone(FlowLimit(messages=rate)), *batches)
    assert passed <= now * rate + max(1.0, rate * BURST) + 1
    passed = sent(alone(FlowLimit(bytes=rate * size)), *batches)
    assert passed <= now * rate + rate * BURST + 1


def test_a_message_that_is_larger_than_the_limit_passes_and_is_made_up_for() -> None:
    flow, map_ = alone(FlowLimit(bytes=100_000)), frames(1_000_000)
    assert sent(flow, *((now / 2, map_) for now in range(200))) == 10


def test_the_first_of_a_batch_pass() -> None:
    flow = alone(FlowLimit(messages=20, bytes=200))
    assert flow.room(frames(*[4] * 30), 0.0) == 10
    assert flow.room(frames(50, 30, 30, 4), 0.0) == 3
    equal = Batch(memoryview((struct.pack("<I", 46) + bytes(46)) * 8), 8, None)
    assert flow.room(equal, 0.0) == 2
    assert (equal.head(2).messages, len(equal.head(2).view), equal.head(2).last) == (2, 100, 50)


def test_another_limit_counts_at_once() -> None:
    flow = SharedRateLimit(FlowLimit(messages=10), 0.0)
    share = flow.of("")
    assert sent(share, (0.0, frames(*[4] * 9))) == 5
    flow.set(FlowLimit(messages=1000), 0.0)
    assert sent(share, (0.0, frames(4))) == 0
    flow.set(UNLIMITED, 0.0)
    assert sent(share, (0.0, frames(*[4] * 5000))) == 5000
    flow.set(FlowLimit(messages=10), 0.0)
    assert sent(share, (0.0, frames(*[4] * 9))) == 5


def test_connections_with_the_same_names_have_one_flow() -> None:
    flows = RateLimits(lambda: 0.0)
    one = flows.of(FlowLimit(5), "/scan", "10.0.0.1", "/ear")
    assert one is not None
    assert flows.of(FlowLimit(7), "/scan", "10.0.0.1", "/ear") is one
    assert flows.of(FlowLimit(7), "/scan", "10.0.0.2", "/ear") is not one
    assert flows.of(UNLIMITED, "/scan", "10.0.0.3", "/ear") is None


def test_unused_flows_are_forgotten_once_they_are_paid() -> None:
    now = 0.0
    flows = RateLimits(lambda: now)

    def come_and_go(size: int) -> int:
        for number in range(10_000):
            share = flows.of(FlowLimit(bytes=1), "/scan", f"{size} {number}")
            assert share is not None
            sent(share, (now, frames(size)))
        return len(flows.flows)

    assert come_and_go(1 << 10) <= 3 * 4096
    now = 1e9
    assert come_and_go(4) <= 3 * 4096


def flood(share: RateAllowance, until: float) -> list[tuple[float, RateAllowance, Batch]]:
    return [(number / 100, share, frames(*[4] * 50)) for number in range(int(until * 100))]


def passed(events: list[tuple[float, RateAllowance, Batch]]) -> dict[RateAllowance, int]:
    counts = {holder: 0 for _, holder, _ in events}
    for now, holder, batch in sorted(events, key=lambda event: event[0]):
        counts[holder] += sent(holder, (now, batch))
    return counts


@pytest.mark.parametrize("guests", [1, 2, 20])
def test_a_host_within_its_part_loses_nothing_because_of_others(guests: int) -> None:
    flow = SharedRateLimit(FlowLimit(messages=40), 0.0)
    robot, *others = (flow.of(name) for name in ["robot", *map(str, range(guests))])
    part = 40 / (guests + 1)
    regular = [(number / part, robot, frames(4)) for number in range(int(20 * part))]
    counts = passed(regular + [event for other in others for event in flood(other, 20)])
    assert counts[robot] == len(regular)
    assert sum(counts.values()) <= 20 * 40 + max(20, 2 * (guests + 1)) + guests + 1


def test_the_unused_part_of_a_host_goes_to_the_others() -> None:
    flow = SharedRateLimit(FlowLimit(messages=100), 0.0)
    idle = [flow.of(str(number)) for number in range(8)]
    one, other = flow.of("one"), flow.of("other")
    assert passed(flood(one, 10))[one] >= 1000
    slow = [(10 + number / 5, other, frames(4)) for number in range(50)]
    late = [(10 + now, share, batch) for now, share, batch in flood(one, 10)]
    counts = passed(late + slow)
    assert (counts[other], counts[one] >= 940) == (50, True)
    both = [(20 + now, share, batch) for share in (one, other) for now, share, batch in flood(share, 10)]
    counts = passed(both)
    assert abs(counts[one] - counts[other]) <= 100
    assert len(idle) == 8


@given(st.lists(st.tuples(st.floats(0, 0.2), st.integers(0, 4), st.integers(1, 30)), max_size=60))
def test_holders_together_get_no_more_than_the_limit(sends: list[tuple[float, int, int]]) -> None:
    flow = SharedRateLimit(FlowLimit(messages=10), 0.0)
    shares = [flow.of(str(number)) for number in range(5)]
    now, count = 0.0, 0
    for gap, who, messages in sends:
        now += gap
        count += sent(shares[who], (now, frames(*[4] * messages)))
    assert count <= 10 * now + max(10 * BURST, 2 * 5) + 5


def test_a_large_message_is_made_up_for_by_its_host_alone() -> None:
    flow = SharedRateLimit(FlowLimit(bytes=1000), 0.0)
    robot, guest = flow.of("robot"), flow.of("guest")
    assert sent(guest, (0.0, frames(1_000_000))) == 1
    assert sent(robot, *((number / 5, frames(100)) for number in range(100))) == 100
    assert sent(guest, (20.0, frames(100))) == 0


def test_a_holder_that_leaves_and_comes_back_wins_nothing() -> None:
    flows = RateLimits(lambda: 0.0)
    limit = FlowLimit(messages=20)
    counts = 0
    for number in range(100):
        share = flows.of(limit, "/scan", "10.0.0.9", holder=f"key {number}")
        assert share is not None
        counts += sent(share, (0.0, frames(*[4] * 50)))
        del share
    assert counts <= 11


def test_names_of_a_host_share_its_limit() -> None:
    """Fifteen nodes of one host together get the limit of one node, in equal parts."""
    flows = RateLimits(lambda: 0.0)
    shares = [flows.of(FlowLimit(messages=30), "/scan", "10.0.0.9", holder=str(name)) for name in range(15)]
    counts = passed([event for share in shares if share is not None for event in flood(share, 10)])
    assert sum(counts.values()) <= 300 + 30 + 15
    assert min(counts.values()) >= 18


def test_a_publication_has_its_own_limit_and_a_part_of_its_topics() -> None:
    told: list[tuple[str, int, int]] = []
    together = SharedRateLimit(FlowLimit(messages=8), 0.0)
    flow, other = (PublicationRateLimit(share(), lambda *row: told.append(row)) for _ in range(2))
    flow.set(alone(FlowLimit(messages=6)), together.of("one"))
    other.set(None, together.of("other"))
    passed = [one.passing(frames(*[10] * 5), 0.0, latching=False) for one in (flow, other, flow)]
    assert [one.messages if one is not None else 0 for one in passed] == [3, 1, 0]
    assert told == [("publisher", 2, 20), ("topic", 4, 40), ("publisher", 5, 50)]


def test_the_last_message_of_a_latching_publisher_comes_later() -> None:
    memory = share()
    flow = PublicationRateLimit(memory, lambda _part, _messages, _size: None)
    flow.set(alone(FlowLimit(messages=2)), None)
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


def test_a_leaving_holder_gives_its_amount_to_all() -> None:
    limit = SharedRateLimit(FlowLimit(messages=8), 0.0)
    first, second = limit.of("/a"), limit.of("/b")
    assert sent(second, (0.0, frames(*[8] * 20))) == 3  # its own, and all in common
    assert first.room(frames(8), 0.0) == 1
    del first
    third = limit.of("/c")
    assert (sent(third, (0.0, frames(*[8] * 20))), sent(second, (0.0, frames(8)))) == (1, 0)
