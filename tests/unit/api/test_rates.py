"""Tests of `appliance.api.rates`."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.api.rates import Buckets, peer_key


def test_a_burst_and_then_the_rate() -> None:
    """So many at once, then one for each part of a second; `wait` says what `take` would."""
    buckets = Buckets(2.0, 3)
    assert [buckets.take("a", 0.0) for _ in range(4)] == [0, 0, 0, 0.5]
    assert buckets.wait("a", 0.25) == pytest.approx(0.25)
    assert buckets.take("a", 0.5) == 0
    assert buckets.take("a", 0.5) > 0
    assert buckets.take("b", 0.5) == 0


def test_a_clock_that_stands_gives_nothing() -> None:
    """Without time nothing is added, and time that goes back takes nothing away."""
    buckets = Buckets(1.0, 1)
    assert buckets.take("a", 10.0) == 0
    assert buckets.take("a", 5.0) > 0
    assert buckets.take("a", 6.1) == 0


@given(st.lists(st.integers(0, 10_000), max_size=300))
def test_memory_is_bounded(peers: list[int]) -> None:
    """However many addresses come, there are never more buckets than allowed."""
    buckets = Buckets(1e-6, 5, peers=16)
    hosts = [f"10.0.{peer // 256}.{peer % 256}" for peer in peers]
    for second, host in enumerate(hosts):
        buckets.take(host, float(second))
    remembered = sum(buckets.touched(host, float(len(hosts))) for host in set(hosts))
    assert remembered == min(16, len(set(hosts)))


def test_what_counts_as_one_peer() -> None:
    """An IPv4 address, also when mapped; the /64 of an IPv6 address; a text that is none is itself."""
    assert peer_key("10.0.0.1") == "10.0.0.1"
    assert peer_key("::ffff:10.0.0.1") == "10.0.0.1"
    assert peer_key("2001:db8::1") == peer_key("2001:db8::ffff:2") != peer_key("2001:db8:0:1::1")
    assert peer_key("somewhere") == "somewhere"
