"""A finite thing counted by host, against a naive count."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.quotas.pool import Bounds, Pool, Standing

STRANGER, NAMED, REGISTERED = Standing


def pool(standings: dict[str, Standing], bounds: Bounds) -> Pool[str]:
    """A pool of connections; who is not in `standings` is a stranger."""
    return Pool("connections", bounds, lambda host: standings.get(host, STRANGER))


def test_strangers_have_one_share_together() -> None:
    """Many addresses that no rule names have no more than one share, and a named host still gets its own."""
    shared = pool({"robot": NAMED}, Bounds(whole=100, host=10, strangers=20, kept=30))
    assert not any(shared.take(f"stranger{n}", 10) for n in range(2))
    assert shared.take("stranger3") == (
        "addresses that no rule of the policy names have 20 connections; their share together is 20"
    )
    assert shared.take("robot", 10) == ""
    assert shared.take("robot") == "robot has 10 connections; the share of one host is 10"


def test_what_is_kept_is_for_those_with_a_registration() -> None:
    """When everybody else has come first, a registered host finds what is kept for it, up to the whole."""
    standings = {"robot": REGISTERED} | {f"guest{n}": NAMED for n in range(9)}
    shared = pool(standings, Bounds(whole=100, host=40, strangers=0, kept=30))
    assert [shared.take(f"guest{n}", 35) for n in range(2)] == ["", ""]
    assert (
        shared.take("guest3")
        == "hosts without a registration have 70 connections; 30 of 100 are kept for those with one"
    )
    assert shared.take("robot", 30) == ""
    assert shared.take("robot") == "all hosts together have 100 connections; the limit is 100"


def test_a_host_that_registers_makes_room_for_strangers() -> None:
    """What a host holds is counted under its standing of now, not that of the moment when it was given."""
    standings: dict[str, Standing] = {}
    shared = pool(standings, Bounds(whole=100, host=20, strangers=20, kept=0))
    assert shared.take("new", 20) == ""
    standings["new"] = REGISTERED
    shared.give_back("new")
    assert shared.take("other", 20) == ""
    assert (shared.held_by(STRANGER), shared.held_by(REGISTERED)) == (20, 19)


def test_more_than_it_has_cannot_be_given_back() -> None:
    """An error of the owner's bookkeeping is not swallowed."""
    shared = pool({}, Bounds(whole=1, host=1, strangers=1, kept=0))
    with pytest.raises(ValueError, match="gives back 1 connections and has 0"):
        shared.give_back("host")


@pytest.mark.parametrize("bounds", [(10, 11, 0, 0), (10, 1, 6, 5), (10, -1, 0, 0)])
def test_bounds_that_contradict_each_other_are_refused(bounds: tuple[int, int, int, int]) -> None:
    """A share beyond the whole is an error of the configuration."""
    with pytest.raises(ValueError, match="Bounds"):
        Bounds(*bounds)


@given(
    steps=st.lists(
        st.tuples(st.sampled_from("abcdef"), st.integers(-4, 4), st.sampled_from(list(Standing))), max_size=60
    )
)
def test_no_order_of_events_breaks_a_bound(steps: list[tuple[str, int, Standing]]) -> None:
    """After any takes, returns and changes of standing: totals are sums, and no take went over a bound."""
    bounds = Bounds(whole=12, host=5, strangers=6, kept=3)
    standings: dict[str, Standing] = {}
    shared, held = pool(standings, bounds), dict.fromkeys("abcdef", 0)
    for host, amount, standing in steps:
        standings[host] = standing
        if amount < 0:
            shared.give_back(host, given := min(-amount, held[host]))
            held[host] -= given
        elif not shared.take(host, amount):
            held[host] += amount
            assert sum(held.values()) <= bounds.whole
            assert held[host] <= bounds.host
        assert shared.total == sum(held.values()) == sum(shared.held_by(standing) for standing in Standing)
        assert dict(shared.holders()) == {name: amount for name, amount in held.items() if amount}
