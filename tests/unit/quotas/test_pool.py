import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.quotas.pool import Bounds, Pool, QuotaClass

UNKNOWN, NAMED, REGISTERED = QuotaClass


def pool(quota_classes: dict[str, QuotaClass], bounds: Bounds) -> Pool[str]:
    return Pool("connections", bounds, lambda host: quota_classes.get(host, UNKNOWN))


def test_unknown_hosts_have_one_quota_together() -> None:
    shared = pool({"robot": NAMED}, Bounds(whole=100, host=10, unknown=20, kept=30))
    assert not any(shared.take(f"unknown{n}", 10) for n in range(2))
    assert shared.take("unknown3") == (
        "addresses that no rule of the policy names have 20 connections; their quota together is 20"
    )
    assert shared.take("robot", 10) == ""
    assert shared.take("robot") == "robot has 10 connections; the quota of one host is 10"


def test_the_reserve_is_for_registered_hosts() -> None:
    quota_classes = {"robot": REGISTERED} | {f"guest{n}": NAMED for n in range(9)}
    shared = pool(quota_classes, Bounds(whole=100, host=40, unknown=0, kept=30))
    assert [shared.take(f"guest{n}", 35) for n in range(2)] == ["", ""]
    assert (
        shared.take("guest3")
        == "hosts without a registration have 70 connections; 30 of 100 are kept for those with one"
    )
    assert shared.take("robot", 30) == ""
    assert shared.take("robot") == "all hosts together have 100 connections; the limit is 100"


def test_a_host_that_registers_frees_the_quota_of_unknown_hosts() -> None:
    quota_classes: dict[str, QuotaClass] = {}
    shared = pool(quota_classes, Bounds(whole=100, host=20, unknown=20, kept=0))
    assert shared.take("new", 20) == ""
    quota_classes["new"] = REGISTERED
    shared.give_back("new")
    assert shared.take("other", 20) == ""
    assert (shared.held_by(UNKNOWN), shared.held_by(REGISTERED)) == (20, 19)


def test_a_host_cannot_release_more_than_it_has() -> None:
    shared = pool({}, Bounds(whole=1, host=1, unknown=1, kept=0))
    with pytest.raises(ValueError, match="returns 1 connections and has 0"):
        shared.give_back("host")


@pytest.mark.parametrize(("share", "taken"), [(0, [32, 0, 0]), (1, [16, 8, 4]), (3, [24, 6, 1])])
def test_a_host_gets_one_and_further_ones_by_what_it_leaves(share: int, taken: list[int]) -> None:
    bounds = Bounds(whole=32, host=32, unknown=0, kept=0, share=share)
    shared: Pool[str] = Pool("connections", bounds, lambda _host: REGISTERED)
    for host in "abc":
        while not shared.take(host):
            pass
    assert [shared.held(host) for host in "abc"] == taken
    others = [shared.take(f"other{number}") for number in range(40)]
    assert others.count("") == 32 - sum(taken)
    assert others[-1] == "all hosts together have 32 connections; the limit is 32"


def test_the_refusal_of_a_share_names_its_numbers() -> None:
    assert Bounds(32, 32, 0, 0, share=3).share_refusal("a", 25, 25, "connections") == (
        "a would use 25 connections, leaving 7 for all others; a host may use at most 3 times as many as it leaves"
    )
    assert (
        Bounds(32, 32, 0, 0, share=1)
        .share_refusal("a", 17, 17, "connections")
        .endswith("at most as many as it leaves")
    )


@pytest.mark.parametrize("bounds", [(10, 11, 0, 0), (10, 1, 6, 5), (10, -1, 0, 0)])
def test_bounds_that_contradict_each_other_are_refused(bounds: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match="Bounds"):
        Bounds(*bounds)


@given(
    steps=st.lists(
        st.tuples(st.sampled_from("abcdef"), st.integers(-4, 4), st.sampled_from(list(QuotaClass))),
        max_size=60,
    )
)
def test_no_order_of_events_breaks_a_bound(steps: list[tuple[str, int, QuotaClass]]) -> None:
    bounds = Bounds(whole=12, host=5, unknown=6, kept=3)
    quota_classes: dict[str, QuotaClass] = {}
    shared, held = pool(quota_classes, bounds), dict.fromkeys("abcdef", 0)
    for host, amount, quota_class in steps:
        quota_classes[host] = quota_class
        if amount < 0:
            shared.give_back(host, given := min(-amount, held[host]))
            held[host] -= given
        elif not shared.take(host, amount):
            held[host] += amount
            assert sum(held.values()) <= bounds.whole
            assert held[host] <= bounds.host
        assert (
            shared.total
            == sum(held.values())
            == sum(shared.held_by(quota_class) for quota_class in QuotaClass)
        )
        assert dict(shared.holders()) == {name: amount for name, amount in held.items() if amount}
