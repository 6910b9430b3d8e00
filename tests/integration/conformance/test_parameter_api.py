"""The parameter server answers as a plain ROS master does: values, trees, scopes, upward search and watchers.

The cases follow ROS's own test of its parameter server (ros_comm, test_rosmaster).
"""

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
VALUES: list[Any] = [
    0, 1024, 2**31 - 1, -(2**31), True, False, "", "x", "hello world", "ünïcode & <xml> ]]>", "\t two\nlines ",
    0.0, -0.0, math.pi, 3.4028235e38, -1e-300, 1e300, math.inf, -math.inf, math.nan, [], [1, 2, 3], ["a", "b"],
    [0.0, -4.5], [1, "a", math.pi, False], [[1, 2], ["a"], []], {}, {"a": 2, "b": 4}, {"a": {"b": {"c": "d"}}},
    {"list": [{"x": 1}, {"y": [2]}]}, {"z": 1, "a": 2}, Binary(b""), Binary(bytes(range(256))),
    DateTime("20051206T12:13:14"), [Binary(b"x"), DateTime("14921206T12:13:14")],
]  # fmt: skip


def all_names_and_values(both: BothMasters) -> list[Step]:
    """Return the whole tree and the list of names, which must be the same on both masters."""
    return [("getParam", TESTER, "/"), ("getParamNames", TESTER)]


def compare(both: BothMasters, *steps: Step) -> list[Any]:
    """Make every call to both, compare the answers and the final trees, and return the appliance's answers."""
    answers = []
    for step in steps:
        answer = both.call(*step)
        assert differences(answer) == [], step
        answers.append(answer.appliance)
        for look in all_names_and_values(both):
            assert differences(both.call(*look)) == [], f"{look[0]} after {step}"
    return answers


@pytest.mark.parametrize(
    "value", VALUES, ids=[f"{type(value).__name__} {number}" for number, value in enumerate(VALUES)]
)
def test_value(both: BothMasters, value: Any) -> None:
    """Every kind of value is stored and returned unchanged, alone and within its tree."""
    compare(
        both,
        ("setParam", TESTER, "/kept/value", value),
        ("hasParam", TESTER, "/kept/value"),
        ("getParam", TESTER, "/kept/value"),
        ("getParam", TESTER, "/kept"),
        ("deleteParam", TESTER, "/kept/value"),
        ("hasParam", TESTER, "/kept/value"),
        ("hasParam", TESTER, "/kept"),
    )


def test_tree(both: BothMasters) -> None:
    """A dictionary is a namespace and vice versa; setting a key below a value turns the value into a namespace."""
    compare(
        both,
        ("setParam", TESTER, "/gains/P", 1),
        ("setParam", TESTER, "/gains/I", 2),
        ("getParam", TESTER, "/gains"),
        ("getParam", TESTER, "/gains/"),
        ("getParam", TESTER, "//gains//P"),
        ("setParam", TESTER, "/gains", {"D": 3}),
        ("getParam", TESTER, "/gains/P"),
        ("setParam", TESTER, "/gains/D/deep/er", 4),
        ("setParam", TESTER, "/gains/D", 5),
        ("getParam", TESTER, "/gains/D/deep"),
        ("hasParam", TESTER, "/gains/D/deep"),
        ("deleteParam", TESTER, "/gains/D/deep"),
        ("deleteParam", TESTER, "/gains/X"),
        ("setParam", TESTER, "/gains/text", "abc"),
        ("deleteParam", TESTER, "/gains/text/a"),
        ("deleteParam", TESTER, "/gains"),
        ("deleteParam", TESTER, "/gains"),
        ("setParam", TESTER, "/", 5),
        ("setParam", TESTER, "/", {"only": {"this": 1}}),
        ("deleteParam", TESTER, "/"),
        ("setParam", TESTER, "/empty", {}),
        ("getParam", TESTER, "/empty"),
        ("setParam", TESTER, "/", {}),
    )


def test_scopes(both: BothMasters) -> None:
    """A relative key is in the caller's namespace and a private key in the caller's name; neither is searched for."""
    compare(
        both,
        ("setParam", "/down/one/two/node", "depth", 3),
        ("getParam", "/down/one/two/node", "depth"),
        ("getParam", "/down/one/node", "depth"),
        ("getParam", "/down/one/node", "two/depth"),
        ("hasParam", "/down/one/two/other/node", "depth"),
        ("setParam", "/node", "down/one/two/depth", 4),
        ("getParam", "/down/one/two/node", "depth"),
        ("setParam", "/down/node", "~mine", 5),
        ("getParam", "/down/node", "~mine"),
        ("getParam", "/down/other", "~mine"),
        ("getParam", "/down/other", "node/mine"),
        ("deleteParam", "/down/node", "~mine"),
        ("deleteParam", "/down/node", "one/two/depth"),
        ("getParam", "", "down"),
        ("hasParam", "", "down/one"),
    )


def test_search(both: BothMasters) -> None:
    """`searchParam` searches upwards for the first part of the key and appends the rest, which need not exist."""
    leaf = {"p1": 1, "p2": {"q": 2}}
    callers = [
        "/root", "/l1/node", "/l1/l2/node", "/l1/l2/l3/l4/node", "/l1/other/l3/node", "/not/l1/l2/node", "/l1",
    ]  # fmt: skip
    for place in ("/param", "/l1/param", "/l1/l2/param", "/l1/l2/l3/l4/param", "/l1/node/param"):
        compare(both, ("setParam", TESTER, place, leaf))
        for caller in callers:
            for key in (
                "param",
                "param/p1",
                "param/p2/q",
                "param/p2/missing",
                "missing",
                "/param/p1",
                "/missing",
            ):
                answer = both.call("searchParam", caller, key)
                assert differences(answer) == [], (caller, key)
    compare(both, ("deleteParam", TESTER, "/l1/l2/param/p2"), ("searchParam", "/l1/l2/node", "param/p2/q"))


def test_search_for_a_private_name(both: BothMasters) -> None:
    """Searching for a private name is an error on both masters (a plain master reports an internal error)."""
    answers = both.call("searchParam", TESTER, "~param")
    assert (answers.plain[0], answers.appliance[0]) == (0, -1)


@pytest.mark.parametrize("watched", ["/arm", "/arm/", "/arm/speed", "/", "arm/joint", "~own"])
def test_watchers_get_the_same_updates(both: BothMasters, watched: str) -> None:
    """Subscribers of a key get the same changes, with the same values, in the same order."""
    ear = Api("ear")
    compare(both, ("setParam", TESTER, "/arm/speed", 0), ("subscribeParam", "/ear", ear, "/settled"))
    for number, step in enumerate(
        (
            ("subscribeParam", "/ear", ear, watched),
            ("subscribeParam", "/ear", ear, watched),
            ("setParam", TESTER, "/arm/speed", 1),
            ("setParam", TESTER, "/arm/joint/left", [1, 2]),
            ("setParam", TESTER, "/arm", {"speed": 2, "joint": {"left": 3, "right": 4}}),
            ("setParam", TESTER, "/other", 1),
            ("setParam", "/ear", "/arm/speed", 5),
            ("setParam", "/ear", "~own", {"a": 1}),
            ("deleteParam", TESTER, "/arm/joint"),
            ("deleteParam", TESTER, "/arm"),
            ("unsubscribeParam", "/ear", ear, watched),
            ("setParam", TESTER, "/arm/speed", 10),
        )
    ):
        # A plain master sends the tree as it is when it sends; so wait for the update before the next change.
        compare(both, step, ("setParam", TESTER, "/settled", number))
        for side in (both.plain, both.appliance):
            assert side.nodes.wait_until(lambda side=side, number=number: _has_settled(side, number))  # type: ignore[misc]  # mypy does not infer a lambda with defaults
    told = both.calls_made(lambda call: call.method == "paramUpdate")
    assert told.plain == told.appliance


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
    """For any order of watching, setting and deleting, every watcher gets the same updates of every single write."""
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


def _has_settled(side: MasterSide, number: int) -> bool:
    return any(call.params[1:] == ("/settled/", number) for call in side.nodes.all_calls())


def test_ten_thousand_parameters(both: BothMasters) -> None:
    """A tree of 10,000 parameters is set, listed, read and cleared, as a whole and one by one."""
    tree = {f"group_{group}": {f"p{number}": number for number in range(100)} for group in range(100)}
    compare(
        both,
        ("setParam", TESTER, "/large", tree),
        ("getParam", TESTER, "/large/group_99/p99"),
        ("setParam", TESTER, "/large/group_99/p99", "changed"),
        ("searchParam", "/large/group_5/node", "p7"),
    )
    parts = [
        {"methodName": "setParam", "params": [TESTER, f"/many/p{number}", number]} for number in range(2000)
    ]
    answers = both.call("system.multicall", parts)
    assert answers.plain == answers.appliance
    compare(both, ("deleteParam", TESTER, "/large"), ("deleteParam", TESTER, "/many"))


def test_any_multicall_runs_in_order(both: BothMasters) -> None:
    """Sequences of sets, deletions and reads, mixed with other calls and errors, are answered as by a plain master."""
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
        for look in all_names_and_values(both):
            assert differences(both.call(*look)) == [], parts
