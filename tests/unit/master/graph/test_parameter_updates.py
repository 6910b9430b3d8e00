import asyncio
import copy
import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.master.graph.registry import Kind
from appliance.master.reconcile.subscribers import settled, updates_of
from roswire.xmlrpc import Value
from tests.support.control_parts import OPEN, ControlParts
from tests.support.examples import examples
from tests.support.nodes import answering

ORACLE = """
import json, sys
from rosmaster.paramserver import compute_param_updates
from rosmaster.registrations import Registrations
for line in sys.stdin:
    subscribed, key, value, caller = json.loads(line)
    registrations = Registrations(Registrations.PARAM_SUBSCRIPTIONS)
    for name, one in subscribed:
        registrations.register(one if one == "/" else one + "/", name, "http://" + name)
    told = compute_param_updates(registrations, key, value, caller)
    print(json.dumps([[api[0], at, what] for apis, at, what in told for api in apis]), flush=True)
"""
PART = st.sampled_from(["a", "b", "ab", "c"])
KEY = st.lists(PART, max_size=3).map(lambda parts: "/" + "/".join(parts))
NAMESPACE: st.SearchStrategy[Any] = st.recursive(
    st.dictionaries(PART, st.one_of(st.integers(0, 3), st.just([{"a": 1}]), st.just({})), max_size=3),
    lambda inner: st.dictionaries(PART, inner, max_size=3),
    max_leaves=8,
)
CALLER = st.sampled_from(["/n1", "/n2", "/n3"])
SUBSCRIBED = st.lists(st.tuples(CALLER, KEY), max_size=8, unique=True)


@pytest.fixture(scope="module")
def oracle() -> Iterator[Callable[[Any], Any]]:
    with answering("-c", ORACLE) as ask:
        yield ask


def in_order(told: list[Any]) -> list[str]:
    return sorted(json.dumps(one, sort_keys=True) for one in told)


@pytest.mark.nightly
@settings(max_examples=examples(400), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    SUBSCRIBED,
    KEY,
    st.one_of(st.integers(0, 3), st.just([{"a": 1}]), NAMESPACE),
    st.one_of(CALLER, st.none()),
)
def test_updates_equal_those_of_a_plain_master(
    oracle: Callable[[Any], Any], subscribed: list[tuple[str, str]], key: str, value: Any, caller: str | None
) -> None:
    value = {} if caller is None else value  # deleted
    below = sorted({one for _, one in subscribed if one != key and one.startswith(key.rstrip("/") + "/")})
    told = [
        [name, f"{update.key.rstrip('/')}/", update.value]
        for update in updates_of(key, value, below)
        for name, one in subscribed
        if one == update.subscribed and not (update.key == key and name == caller)
    ]
    assert in_order(told) == in_order(oracle([subscribed, key, value, caller]))


@given(
    KEY,
    st.recursive(
        st.integers(0, 3),
        lambda inner: st.dictionaries(st.text("/~ab", max_size=3), inner, max_size=3),
        max_leaves=8,
    ),
    st.lists(KEY, max_size=5),
)
def test_no_update_has_an_undecided_key(key: str, value: Any, others: list[str]) -> None:
    below = [one for one in others if one != key and one.startswith(key.rstrip("/") + "/")]
    for update in updates_of(key, value, below):
        assert update.key in {key, *below}


def test_an_update_has_the_value_that_was_set() -> None:
    tree: dict[str, Value] = {"a": {"b": 1}, "c": [1]}
    kept = settled(tree)
    before = copy.deepcopy(kept)
    namespace = tree["a"]
    assert isinstance(namespace, dict)
    namespace["b"] = 2
    assert kept == before


@pytest.mark.anyio
async def test_a_subscription_during_a_write_gets_the_new_value() -> None:
    for first in ("subscribeParam", "setParam"):
        world = await ControlParts.begun()
        calls = {
            "setParam": world.ask("setParam", "/me", "/arm", 2),
            "subscribeParam": world.ask("subscribeParam", "/robot", "http://10.0.0.5:4001/", "/arm"),
        }
        order = sorted(calls, key=lambda name: name != first)
        answers: list[Any] = await asyncio.gather(*(calls[name] for name in order))
        await world.settle()
        told = [one for one in world.deliveries.told if one[1] == "paramUpdate"]
        assert answers[order.index("subscribeParam")][2] == ({} if first == "subscribeParam" else 2)
        assert told == ([("/robot", "paramUpdate", ("/arm/", 2))] if first == "subscribeParam" else [])


@pytest.mark.anyio
async def test_an_update_of_the_whole_tree_needs_the_right_to_all_of_it() -> None:
    world = await ControlParts.begun()
    world.reload(f"{OPEN}[Parameters]\nread /arm = 10.0.0.5\nread default = 10.0.0.9\n")
    node = world.node("/n")
    await world.register(node, Kind.PARAMETER, "/", "")
    world.parameters.replace({"arm": 4711})
    world.subscribers.tell_parameters(node)
    assert not [one for one in world.deliveries.told if one[1] == "paramUpdate"]
    assert ("deny", "/") in world.records.pairs
