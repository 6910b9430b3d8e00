import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from appliance.api.front.rates import Buckets


def test_a_burst_is_followed_by_the_rate() -> None:
    buckets = Buckets(2.0, 3)
    assert [buckets.take("a", 0.0) for _ in range(4)] == [0, 0, 0, 0.5]
    assert buckets.wait("a", 0.25) == pytest.approx(0.25)
    assert buckets.take("a", 0.5) == 0
    assert buckets.take("a", 0.5) > 0
    assert buckets.take("b", 0.5) == 0


def test_a_stopped_clock_adds_nothing() -> None:
    buckets = Buckets(1.0, 1)
    assert buckets.take("a", 10.0) == 0
    assert buckets.take("a", 5.0) > 0
    assert buckets.take("a", 6.1) == 0


@given(st.lists(st.integers(0, 10_000), max_size=300))
@example(list(range(40)))
def test_memory_is_bounded(peers: list[int]) -> None:
    buckets = Buckets(1e-6, 5, peers=16)
    hosts = [f"10.0.{peer // 256}.{peer % 256}" for peer in peers]
    for second, host in enumerate(hosts):
        buckets.take(host, float(second))
    remembered = sum(buckets.is_touched(host, float(len(hosts))) for host in set(hosts))
    assert remembered == min(16, len(set(hosts)))
