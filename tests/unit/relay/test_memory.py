"""No host takes the memory that the others need, and nothing holds memory for what never comes."""

import gc

from appliance.relay.frames import MemoryBudget
from appliance.relay.memory import HostShares, Stall


def test_a_host_with_a_quarter_gets_no_more_while_half_is_in_use() -> None:
    """Alone it may have half; another host still gets its quarter then."""
    budget = MemoryBudget(100)
    shares = HostShares(budget)
    greedy, other, third = (shares.of(host) for host in ("a", "b", "c"))
    greedy.used += 49
    assert not greedy.exhausted
    greedy.used += 1
    assert (greedy.exhausted, other.exhausted) == (True, False)
    other.used += 25
    assert (other.exhausted, third.exhausted, budget.used) == (True, False, 75)
    third.used += 25
    assert third.exhausted
    greedy.used -= 40
    other.used -= 15
    assert (greedy.exhausted, other.exhausted, third.exhausted) == (False, False, False)
    assert shares.of("a") is greedy


def test_a_host_that_is_gone_leaves_nothing() -> None:
    """Its share lives as long as something counts in it."""
    shares = HostShares(MemoryBudget(100))
    shares.of("a").used += 0
    gc.collect()
    assert len(shares._shares) == 0


def test_a_stall_is_what_does_not_change() -> None:
    """Neither what grows nor what is finished."""
    stall = Stall(10)
    assert not any(stall.seen(held, now) for held, now in ((5, 0), (5, 10), (6, 11), (6, 21)))
    assert stall.seen(6, 21.5)
    assert not any(stall.seen(held, now) for held, now in ((0, 22), (6, 40), (6, 50)))
