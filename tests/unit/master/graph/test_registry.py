import ipaddress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.master.graph.registry import (
    HostFullError,
    Incarnation,
    Kind,
    Life,
    NodeRegistration,
    Registry,
    new_key,
)
from roswire.uris import parse_node_uri
from tests.support.examples import examples

HOSTS = [ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")]
STEP = st.tuples(
    st.sampled_from(["register", "register", "unregister", "replace", "overshadow", "revive", "forget"]),
    st.integers(0, 5),
    st.sampled_from(list(Kind)),
    st.sampled_from(["/x", "/y"]),
)


def incarnation(number: int) -> Incarnation:
    api = f"http://h:{40000 + number}/"
    return Incarnation(
        new_key(), f"/n{number % 3}", HOSTS[number % 2], parse_node_uri(api), api, "10.0.0.9", 1, 2
    )


@settings(max_examples=examples(300))
@given(steps=st.lists(STEP, max_size=40))
def test_invariants(steps: list[tuple[str, int, Kind, str]]) -> None:
    """A name has one live incarnation, replaced incarnations do not count, and the indexes equal a full scan."""
    registry = Registry()
    known = [incarnation(number) for number in range(6)]
    for one in known:
        registry.add(one)
    for do, number, kind, resource in steps:
        one = known[number]
        if registry.by_key(one.key) is None or one.life is Life.REPLACED:
            continue
        match do:
            case "register":
                holder = registry.holder(one.name)
                if holder is not None and holder is not one:  # as `Graph.registered` does
                    registry.replace(holder, 1.0)
                if one.life is Life.SHADOW:
                    registry.revive(one, 2.0)
                registry.register(one, kind, resource, "t")
            case "unregister":
                registry.unregister(one, kind, resource)
            case "replace" if one.life is Life.LIVE:
                registry.replace(one, 1.0)
            case "overshadow" if one.life is Life.LIVE and one.registrations:
                registry.overshadow(one, 1.0)
            case "revive" if one.life is Life.SHADOW and registry.holder(one.name) is None:
                registry.revive(one, 2.0)
            case "forget":
                registry.forget(one)
        check(registry, known)


def check(registry: Registry, known: list[Incarnation]) -> None:
    there = [one for one in known if registry.by_key(one.key) is one]
    assert registry.all() == there
    holding = [one for one in there if one.life is Life.LIVE and one.registrations]
    assert len({one.name for one in holding}) == len(holding)
    for one in holding:
        assert registry.holder(one.name) is one
    for kind in Kind:
        for resource in ("/x", "/y"):
            expected = {one.key for one in holding if (kind, resource) in one.registrations}
            assert {registrant.key for registrant in registry.registrants(kind, resource)} == expected
    for host in HOSTS:
        mine = [one for one in there if one.host == host]
        assert registry.nodes_of(host) == len(mine)
        assert registry.registrations_of(host) == sum(len(one.registrations) for one in mine)
    pairs: list[tuple[Incarnation, NodeRegistration]] = list(registry.in_order())
    orders = [registration.order for _, registration in pairs]
    assert orders == sorted(set(orders))
    assert {one.key for one, _ in pairs} == {one.key for one in holding}


def test_the_node_that_was_lost_first_makes_room() -> None:
    registry = Registry(3)
    known = [incarnation(number) for number in (0, 2, 4)]
    for one in known:
        registry.add(one)
        registry.register(one, Kind.PUBLICATION, "/x", "t")
    with pytest.raises(HostFullError, match="has 3 nodes, the limit for one host"):
        registry.room_for("/new", HOSTS[0], "http://new:1/")
    registry.overshadow(known[2], 5.0)
    registry.overshadow(known[1], 7.0)
    assert registry.room_for("/new", HOSTS[0], "http://new:1/") is known[2]
    assert registry.room_for(known[0].name, HOSTS[0], known[0].api_text) is None
    assert registry.room_for("/new", HOSTS[1], "http://new:1/") is None


def test_a_node_without_registrations_makes_room_first() -> None:
    registry = Registry()
    lost, idle, busy = incarnation(0), incarnation(2), incarnation(4)
    for one in (lost, idle, busy):
        registry.add(one)
        registry.register(one, Kind.PUBLICATION, "/x", "t")
    registry.overshadow(lost, 5.0)
    assert registry.evictable_for(HOSTS[1], lost_before=5.0) is None
    for one in (idle, busy):
        registry.unregister(one, Kind.PUBLICATION, "/x")
    busy.calls = 1
    assert registry.evictable_for(HOSTS[0], lost_before=5.0) is idle
    assert registry.evictable_for(HOSTS[1], lost_before=5.0) is idle
    registry.forget(idle)
    assert registry.evictable_for(HOSTS[1], lost_before=5.0) is None
    assert registry.evictable_for(HOSTS[0], lost_before=5.0) is lost
    assert registry.evictable_for(HOSTS[1], lost_before=5.1) is lost
    busy.calls = 0
    assert registry.evictable_for(HOSTS[1], lost_before=5.0) is busy


def test_forgetting_one_incarnation_keeps_the_next() -> None:
    registry = Registry()
    first, second = incarnation(0), incarnation(0)
    registry.add(first)
    registry.replace(first, 1.0)
    registry.add(second)
    registry.forget(first)
    assert registry.find(second.name, second.host, second.api_text) is second
    registry.forget(second)
    assert registry.find(second.name, second.host, second.api_text) is None


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_name_is_restored_to_the_node_with_registrations(order: tuple[int, int]) -> None:
    known = [incarnation(0), incarnation(3)]
    known[1].registrations[Kind.PUBLICATION, "/x"] = NodeRegistration(Kind.PUBLICATION, "/x", "t", 1)
    registry = Registry()
    for number in order:
        registry.restore(known[number])
    assert registry.holder("/n0") is known[1]
