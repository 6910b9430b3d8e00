from ipaddress import IPv4Address

from appliance.features.authority.orders import MAX_WAITING, GroupHolders
from appliance.policy.authority import Claim
from appliance.policy.model import Address
from appliance.policy.policy_compiler import compile_policy

TEXT = "[Authority]\nbase = /cmd_vel\ntake base = 10.0.0.1\nlease base = 2s\n"
GROUP = compile_policy(TEXT, file="site.ini").authority["base"]
DRIVERS: dict[Address, Claim] = {IPv4Address("10.0.0.1"): Claim.TAKE, IPv4Address("10.0.0.2"): Claim.OVERRIDE}


def guest(number: int) -> IPv4Address:
    return IPv4Address("10.9.0.0") + number


MANY = {guest(number) for number in range(MAX_WAITING + 1)}


def test_hosts_that_may_only_ask_keep_no_driver_from_waiting() -> None:
    groups = GroupHolders(lambda _group, host: DRIVERS.get(host, Claim.ASK))
    for number in range(MAX_WAITING):
        assert groups.wait(GROUP, guest(number), 0.0)
    assert not groups.wait(GROUP, guest(99), 0.0)
    for driver in DRIVERS:
        assert groups.wait(GROUP, driver, 0.0)
    waiting = groups.waiting(GROUP, 0.0)
    assert len(waiting) == MAX_WAITING
    assert waiting[:14] == [guest(number) for number in range(14)] and set(waiting[14:]) == set(DRIVERS)
    assert groups.successor(GROUP, 0.0) == next(iter(DRIVERS))


def test_many_addresses_of_a_host_leave_places_to_others() -> None:
    groups = GroupHolders(
        lambda _group, _host: Claim.TAKE, lambda host: "many" if host in MANY else str(host)
    )
    for host in sorted(MANY)[:MAX_WAITING]:
        assert groups.wait(GROUP, host, 0.0)
    drivers = list(DRIVERS)
    assert all(groups.wait(GROUP, driver, 0.0) for driver in drivers)
    assert not groups.wait(GROUP, guest(MAX_WAITING), 0.0), "it has the most"
    assert groups.waiting(GROUP, 0.0) == [*sorted(MANY)[:14], *drivers]


def test_drivers_wait_in_their_order_and_take_no_place_of_one_another() -> None:
    groups = GroupHolders(lambda _group, _host: Claim.TAKE)
    for number in range(MAX_WAITING):
        assert groups.wait(GROUP, guest(number), 0.0)
    assert not groups.wait(GROUP, guest(99), 0.0)
    assert groups.waiting(GROUP, 0.0) == [guest(number) for number in range(MAX_WAITING)]
