"""The host that sets a parameter is charged for it. A naive count of single parameters must agree."""

import contextlib
import copy
import ipaddress
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.master.parameter_charges import APPLIANCE, LimitReachedError, measure, member_weight
from appliance.master.parameter_mirror import ParameterMirror
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, QuotaClass
from roswire.parameter_tree import parts_of
from roswire.xmlrpc import Value
from tests.support.examples import examples
from tests.support.parameters import Owners, mirror, put

ROBOT, GUEST, OTHER, UNKNOWN = (ipaddress.ip_address(f"10.0.0.{number}") for number in (1, 2, 3, 4))
STANDINGS = {
    ROBOT: QuotaClass.REGISTERED,
    GUEST: QuotaClass.NAMED,
    OTHER: QuotaClass.NAMED,
    APPLIANCE: QuotaClass.NAMED,
}
BOUNDS = Bounds(whole=3000, host=1500, unknown=400, kept=1000)
PART = st.sampled_from(["a", "b", "c"])
KEY = st.lists(PART, max_size=4).map(lambda parts: "/" + "/".join(parts))
VALUE: st.SearchStrategy[Any] = st.recursive(
    st.one_of(st.integers(0, 9), st.integers(0, 900).map("x".__mul__), st.just([])),
    lambda inner: st.dictionaries(PART, inner, max_size=3),
    max_leaves=5,
)
HOST: st.SearchStrategy[Address] = st.sampled_from([ROBOT, GUEST, OTHER, UNKNOWN])
STEP = st.one_of(
    st.tuples(st.just("set"), KEY, VALUE, HOST),
    st.tuples(st.just("delete"), KEY, st.none(), HOST),
    st.tuples(st.just("restart"), st.just("/"), st.none(), HOST),
)


def quota_class(host: Address) -> QuotaClass:
    return STANDINGS.get(host, QuotaClass.UNKNOWN)


def charged(there: ParameterMirror) -> dict[Address, int]:
    return dict(there.charges.pool.holders())


class Ledger:
    def __init__(self) -> None:
        self.owners: dict[tuple[str, ...], Address] = {(): APPLIANCE}

    def set(self, tree: Value, key: str, owner: Address) -> None:
        parts = tuple(parts_of(key))
        new = next(
            parts[:depth] for depth in range(len(parts) + 1) if self._is_new(tree, parts[:depth], parts)
        )
        self.drop(new)
        for place in _places(tree):
            if place[: len(new)] == new:
                self.owners[place] = owner

    def drop(self, key: tuple[str, ...]) -> None:
        self.owners = {place: owner for place, owner in self.owners.items() if place[: len(key)] != key}

    def charges(self, tree: Value) -> dict[Address, int]:
        found: Counter[Address] = Counter()
        for place, value in _places(tree).items():
            alone: Value = {} if isinstance(value, dict) else value
            found[self.owners[place]] += member_weight(place[-1], alone) if place else measure(alone)[0]
        return dict(found)

    def _is_new(self, tree: Value, place: tuple[str, ...], whole: tuple[str, ...]) -> bool:
        return place == whole or place not in self.namespaces

    namespaces: frozenset[tuple[str, ...]] = frozenset({()})


def _places(value: Value, place: tuple[str, ...] = ()) -> dict[tuple[str, ...], Value]:
    found = {place: value}
    if isinstance(value, dict):
        for name, member in value.items():
            found |= _places(member, (*place, name))
    return found


@settings(max_examples=examples(400))
@given(st.lists(STEP, max_size=14))
def test_the_host_that_set_a_parameter_is_charged(steps: list[tuple[str, str, Any, Address]]) -> None:
    owners, ledger = Owners(), Ledger()
    there = mirror(owners=owners)
    for do, key, value, host in steps:
        if do == "restart":
            there = mirror(copy.deepcopy(there.tree), owners=owners)
        elif do == "delete":
            there.delete(key)
            if parts_of(key):
                ledger.drop(tuple(parts_of(key)))
        elif key != "/" or isinstance(value, dict):
            ledger.namespaces = frozenset(
                place for place, one in _places(there.tree).items() if isinstance(one, dict)
            )
            put(there, key, copy.deepcopy(value), host)
            ledger.set(there.tree, key, host)
        assert charged(there) == ledger.charges(there.tree)
        assert there.charges.pool.total == there.weight == measure(there.tree)[0]


@settings(max_examples=examples(400))
@given(st.lists(STEP, max_size=20))
def test_no_sequence_exceeds_a_quota(steps: list[tuple[str, str, Any, Address]]) -> None:
    there = mirror(bounds=BOUNDS, quota_class=quota_class)
    for do, key, value, host in steps:
        if do == "delete":
            there.delete(key)
        elif do == "set" and (key != "/" or isinstance(value, dict)):
            with contextlib.suppress(LimitReachedError):
                put(there, key, copy.deepcopy(value), host)
        pool = there.charges.pool
        assert all(amount <= BOUNDS.host for _host, amount in pool.holders())
        assert pool.total == there.weight <= BOUNDS.whole
        assert pool.held_by(QuotaClass.UNKNOWN) <= BOUNDS.unknown
        named = pool.held_by(QuotaClass.NAMED) + pool.held_by(QuotaClass.UNKNOWN)
        assert named <= BOUNDS.whole - BOUNDS.kept


@settings(max_examples=examples(200))
@given(st.lists(STEP, max_size=10), st.integers(0, 3), HOST)
def test_a_value_can_always_be_replaced_by_one_of_its_size(
    steps: list[tuple[str, str, Any, Address]], place: int, host: Address
) -> None:
    there = mirror(bounds=BOUNDS, quota_class=quota_class)
    for do, key, value, who in steps:
        if do == "set" and key != "/":
            with contextlib.suppress(LimitReachedError):
                put(there, key, copy.deepcopy(value), who)
    values = [(key, value) for key, value in _places(there.tree).items() if not isinstance(value, dict)]
    if not values:
        return
    parts, value = values[place % len(values)]
    smaller: Value = value[:-1] if isinstance(value, str) else value
    put(there, "/" + "/".join(parts), smaller, host)


def test_a_guest_fills_only_its_own_quota() -> None:
    there = mirror(bounds=BOUNDS, quota_class=quota_class)
    for number in range(20):
        with contextlib.suppress(LimitReachedError):
            put(there, f"/guest/{number}", "x" * 100, GUEST)
    with pytest.raises(LimitReachedError, match=r"10\.0\.0\.2 has \d+ bytes of parameters; the quota"):
        put(there, "/guest/more", "x" * 1000, GUEST)
    put(there, "/robot", "x" * 1000, ROBOT)
    put(there, "/guest/1", "y", ROBOT)
    put(there, "/robot", "y" * 1000, ROBOT)
    for number in range(20):
        there.delete(f"/guest/{number}")
    put(there, "/guest/more", "x" * 1000, GUEST)


def test_quota_is_reserved_during_a_call_of_rosmaster() -> None:
    there = mirror(whole=1000)
    kept = there.reserve("/a", measure("x" * 400)[0], GUEST)
    second = there.reserve("/b", measure("x" * 300)[0], GUEST)
    with pytest.raises(LimitReachedError):
        there.reserve("/c", measure("x" * 100)[0], GUEST)
    second.release()
    there.reserve("/c", measure("x" * 100)[0], GUEST).release()
    there.set("/a", "x" * 400, kept)
    assert there.charges.pool.total == there.weight


def test_charges_survive_restarts_of_rosmaster_and_control() -> None:
    owners = Owners()
    there = mirror(owners=owners)
    put(there, "/guest/map", "x" * 1000, GUEST)
    put(there, "/robot/name", "r", ROBOT)
    before, tree = charged(there), copy.deepcopy(there.tree)
    again = mirror({"robot": {"name": "r"}}, owners=owners)  # the large value was not saved in time
    again.replace(copy.deepcopy(tree))
    assert charged(again) == before
    again.replace({"robot": {"name": "r"}})
    assert GUEST not in charged(again)
    assert owners.kept == {"/robot": str(ROBOT)}
