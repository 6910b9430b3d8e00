"""The parameter server answers as a plain ROS master does: values, watchers and multicalls."""

import math
import random
from functools import partial
from typing import Any
from xmlrpc.client import Binary, DateTime

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.integration.conformance.side_by_side import (
    TESTER,
    Answers,
    Api,
    BothMasters,
    MasterSide,
    differences,
)
from tests.support.examples import examples

Step = tuple[Any, ...]
SEGMENTS = st.sampled_from(["arm", "speed", "max", "left"])
VALUES_BELOW = st.recursive(
    st.one_of(st.integers(0, 9), st.just([1, {"a": 2}])),
    lambda below: st.dictionaries(SEGMENTS, below, max_size=3),
    max_leaves=6,
)
_LOOKS: list[Step] = [("getParam", TESTER, "/"), ("getParamNames", TESTER)]
VALUES: list[Any] = [
    0, 1024, 2**31 - 1, -(2**31), True, False, "", "x", "hello world", "ünïcode & <xml> ]]>", "\t two\nlines ",
    0.0, -0.0, math.pi, 3.4028235e38, -1e-300, 1e300, math.inf, -math.inf, math.nan, [], [1, 2, 3], ["a", "b"],
    [0.0, -4.5], [1, "a", math.pi, False], [[1, 2], ["a"], []], {}, {"a": 2, "b": 4}, {"a": {"b": {"c": "d"}}},
    {"list": [{"x": 1}, {"y": [2]}]}, {"z": 1, "a": 2}, Binary(b""), Binary(bytes(range(256))),
    DateTime("20051206T12:13:14"), [Binary(b"x"), DateTime("14921206T12:13:14")],
]  # fmt: skip


@pytest.mark.parametrize(
    "value", VALUES, ids=[f"{type(value).__name__} {number}" for number, value in enumerate(VALUES)]
)
def test_value(both: BothMasters, value: Any) -> None:
    """Every kind of value is stored and returned unchanged, alone and within its tree."""
    for step in (("setParam", TESTER, "/kept/value", value), ("getParam", TESTER, "/kept/value"), *_LOOKS):
        assert differences(both.call(*step)) == [], step


_WATCHED = st.sampled_from(["/", "/arm", "/arm/speed", "/arm/speed/max", "/left", "/left/arm"])
_WRITES = st.one_of(
    st.tuples(
        st.just("setParam"),
        st.sampled_from([TESTER, "/ear", "/eye"]),
        _WATCHED.filter("/".__ne__),
        VALUES_BELOW,
    ),
    st.tuples(st.just("deleteParam"), st.just(TESTER), _WATCHED),
)
_WATCHES = st.tuples(
    st.sampled_from(["subscribeParam", "subscribeParam", "unsubscribeParam"]),
    st.sampled_from(["ear", "eye"]),
    _WATCHED,
)


@settings(
    max_examples=examples(60),
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(steps=st.lists(st.one_of(_WATCHES, _WRITES, _WRITES), min_size=3, max_size=12))
def test_watchers_get_the_same_updates_of_any_sequence(both: BothMasters, steps: list[Step]) -> None:
    both.reset()
    for node in ("ear", "eye"):
        both.call("subscribeParam", f"/{node}", Api(node), "/settled")
    for number, (method, who, *rest) in enumerate(steps):
        watches = method in {"subscribeParam", "unsubscribeParam"}
        step = (method, f"/{who}", Api(who), *rest) if watches else (method, who, *rest)
        assert differences(both.call(*step)) == [], step
        both.call("setParam", TESTER, "/settled", number)
        for side in (both.plain, both.appliance):
            for node in ("ear", "eye"):
                settled = partial(_is_told, side, node, number)
                assert side.nodes.wait_until(settled), f"{node} after {step}"
        told = both.calls_made(lambda call: call.method == "paramUpdate" and call.params[1] != "/settled/")
        assert _sorted(told.plain) == _sorted(told.appliance), f"after {step}"
        for side in (both.plain, both.appliance):
            side.nodes.forget()


def _is_told(side: MasterSide, node: str, number: int) -> bool:
    """Whether the node got the update that sets `/settled` to `number`; all earlier updates then have arrived."""
    return any(
        call.node.startswith(f"{node}-") and call.params[1:] == ("/settled/", number)
        for call in side.nodes.all_calls()
    )


def _sorted(told: dict[str, list[Any]]) -> dict[str, list[str]]:
    """Sort the updates of one write, whose order has no meaning."""
    return {node: sorted(map(repr, calls)) for node, calls in told.items()}


def test_any_multicall_runs_in_order(both: BothMasters) -> None:
    dice = random.Random(20)  # noqa: S311  the same calls in every run
    keys = ["/m/a", "/m/a/b", "/m/a/b/c", "/m/d", "m/relative", "/m", "~private", "/m//x", "/m/bad name"]
    for _ in range(30):
        parts = []
        for _ in range(dice.randrange(1, 25)):
            key = dice.choice(keys)
            call = dice.choices(
                [("setParam", [TESTER, key, dice.choice([1, "x", {"b": {"c": 2}}, {}, [1, 2]])]),
                 ("deleteParam", [TESTER, key]), ("hasParam", [TESTER, key]), ("getParam", [TESTER, key]),
                 ("setParam", [TESTER, key]), ("deleteParam", [])],
                [6, 3, 3, 1, 0.3, 0.2],
            )[0]  # fmt: skip
            parts.append({"methodName": call[0], "params": call[1]})
        answers = both.call("system.multicall", parts)
        assert len(answers.appliance) == len(answers.plain)
        for part, plain, ours in zip(parts, answers.plain, answers.appliance, strict=True):
            # A plain master writes its answers after all parts: a returned dictionary shows later changes.
            if isinstance(plain, list) and part["methodName"] != "getParam":
                assert differences(Answers(plain[0], ours[0])) == [], (part, parts)
        for look in _LOOKS:
            assert differences(both.call(*look)) == [], parts
