"""Each call of the Master API, with each kind of argument, is answered as by a plain ROS master.

The cases follow ROS's own test of its master (ros_comm, test_rosmaster).
"""

from functools import partial
from typing import Any

import pytest

from tests.integration.conformance.fake_nodes import NodeCalled
from tests.integration.conformance.side_by_side import (
    TESTER,
    Api,
    BothMasters,
    Fault,
    MasterSide,
    ServiceApi,
    differences,
)

STRING, BOOL = "std_msgs/String", "std_msgs/Bool"
TALKER, EAR = Api("talker"), Api("ear")
Step = tuple[Any, ...]

NO_CALLER = [
    "registerPublisher", "unregisterPublisher", "registerSubscriber", "unregisterSubscriber", "registerService",
    "unregisterService", "lookupNode", "lookupService", "getSystemState", "getTopicTypes", "getPublishedTopics",
    "getUri", "getPid", "getParam", "setParam", "hasParam", "deleteParam", "searchParam", "getParamNames",
    "subscribeParam", "unsubscribeParam",
]  # fmt: skip
TOO_FEW_OR_MANY: list[Step] = [
    ("registerPublisher", TESTER, "/chatter"),
    ("registerPublisher", TESTER, "/chatter", STRING),
    ("registerPublisher", TESTER, "/chatter", STRING, TALKER, "more"),
    ("unregisterPublisher", TESTER, "/chatter"),
    ("unregisterPublisher", TESTER, "/chatter", TALKER, "more"),
    ("registerSubscriber", TESTER, "/chatter"),
    ("registerSubscriber", TESTER, "/chatter", STRING),
    ("unregisterSubscriber", TESTER, "/chatter"),
    ("registerService", TESTER, "/negate"),
    ("registerService", TESTER, "/negate", ServiceApi(4000)),
    ("unregisterService", TESTER, "/negate"),
    ("lookupNode", TESTER),
    ("lookupNode", TESTER, "/a", "/b"),
    ("lookupService", TESTER),
    ("getSystemState", TESTER, "more"),
    ("getTopicTypes", TESTER, "more"),
    ("getUri", TESTER, "more"),
    ("getPid", TESTER, "more"),
    ("shutdown", TESTER),
    ("shutdown", TESTER, "a", "b"),
    ("getParamNames", TESTER, "more"),
    ("getParam", TESTER),
    ("getParam", TESTER, "/a", "/b"),
    ("setParam", TESTER, "/a"),
    ("setParam", TESTER, "/a", 1, 2),
    ("hasParam", TESTER),
    ("deleteParam", TESTER),
    ("searchParam", TESTER),
    ("subscribeParam", TESTER, EAR),
    ("unsubscribeParam", TESTER, EAR),
    ("getPid", 5, 5),
]
WRONG_ARGUMENTS: list[Step] = [
    ("getPid", 5),
    ("getSystemState", [TESTER]),
    ("registerPublisher", TESTER, "", STRING, TALKER),
    ("registerPublisher", TESTER, "/", STRING, TALKER),
    ("registerPublisher", TESTER, 5, STRING, TALKER),
    ("registerPublisher", TESTER, "/two words", STRING, TALKER),
    ("registerPublisher", TESTER, "http://host:80", STRING, TALKER),
    ("registerPublisher", TESTER, "/chatter", "", TALKER),
    ("registerPublisher", TESTER, "/chatter", "String", TALKER),
    ("registerPublisher", TESTER, "/chatter", "a/b/c", TALKER),
    ("registerPublisher", TESTER, "/chatter", 5, TALKER),
    ("registerPublisher", TESTER, "/chatter", STRING, ""),
    ("registerPublisher", TESTER, "/chatter", STRING, "no URI"),
    ("registerPublisher", TESTER, "/chatter", STRING, 5),
    ("unregisterPublisher", TESTER, "", TALKER),
    ("unregisterPublisher", TESTER, "/chatter", ""),
    ("registerSubscriber", TESTER, "", STRING, TALKER),
    ("registerSubscriber", TESTER, "/chatter", "String", TALKER),
    ("registerSubscriber", TESTER, "/chatter", STRING, ""),
    ("unregisterSubscriber", TESTER, "", TALKER),
    ("unregisterSubscriber", TESTER, "/chatter", ""),
    ("registerService", TESTER, "", ServiceApi(4000), TALKER),
    ("registerService", TESTER, "/negate", "", TALKER),
    ("registerService", TESTER, "/negate", ServiceApi(4000), ""),
    ("unregisterService", TESTER, "", ServiceApi(4000)),
    ("unregisterService", TESTER, "/negate", ""),
    ("lookupNode", TESTER, ""),
    ("lookupNode", TESTER, 5),
    ("lookupService", TESTER, ""),
    ("lookupService", TESTER, "/"),
    ("getPublishedTopics", TESTER, 5),
    ("getParam", TESTER, ""),
    ("getParam", TESTER, 5),
    ("getParam", TESTER, None),
    ("setParam", TESTER, "", 1),
    ("setParam", TESTER, "/a", None),
    ("hasParam", TESTER, ""),
    ("deleteParam", TESTER, ""),
    ("searchParam", TESTER, ""),
    ("subscribeParam", TESTER, "", "/a"),
    ("subscribeParam", TESTER, EAR, ""),
    ("unsubscribeParam", TESTER, EAR, ""),
]
SEQUENCES: dict[str, list[Step]] = {
    "publisher": [
        ("registerPublisher", "/talker", "/chatter", STRING, TALKER),
        ("registerPublisher", "/talker", "/chatter", STRING, TALKER),
        ("lookupNode", TESTER, "/talker"),
        ("lookupNode", TESTER, "talker"),
        ("getPublishedTopics", TESTER, ""),
        ("getPublishedTopics", TESTER, "/"),
        ("getTopicTypes", TESTER),
        ("unregisterPublisher", "/talker", "/other", TALKER),
        ("unregisterPublisher", "/talker", "/chatter", Api("talker", 2)),
        ("unregisterPublisher", "/nobody", "/chatter", TALKER),
        ("unregisterPublisher", "/talker", "/chatter", TALKER),
        ("unregisterPublisher", "/talker", "/chatter", TALKER),
        ("lookupNode", TESTER, "/talker"),
        ("getPublishedTopics", TESTER, ""),
        ("getTopicTypes", TESTER),
    ],
    "ten topics of one node": [
        *(("registerPublisher", "/talker", f"/t{number}", STRING, TALKER) for number in range(10)),
        *(("registerSubscriber", "/talker", f"/t{number}", STRING, TALKER) for number in range(10)),
        *(("unregisterPublisher", "/talker", f"/t{number}", TALKER) for number in range(10)),
    ],
    "any type is replaced by a type, and not the other way round": [
        ("registerPublisher", "/talker", "/typed", "*", TALKER),
        ("getTopicTypes", TESTER),
        ("registerPublisher", "/talker", "/typed", STRING, TALKER),
        ("getTopicTypes", TESTER),
        ("registerPublisher", "/talker", "/typed", "*", TALKER),
        ("getTopicTypes", TESTER),
        ("registerPublisher", "/talker", "/typed", BOOL, TALKER),
        ("getPublishedTopics", TESTER, ""),
    ],
    "a subscriber sets the type where nobody did": [
        ("registerSubscriber", "/ear", "/untyped", "*", EAR),
        ("getTopicTypes", TESTER),
        ("registerSubscriber", "/ear", "/untyped", STRING, EAR),
        ("registerSubscriber", "/ear", "/untyped", BOOL, EAR),
        ("getTopicTypes", TESTER),
        ("getPublishedTopics", TESTER, ""),
    ],
    "subscriber": [
        ("registerSubscriber", "/ear", "/chatter", STRING, EAR),
        ("registerPublisher", "/talker", "/chatter", STRING, TALKER),
        ("registerPublisher", "/second", "/chatter", STRING, Api("second")),
        ("registerSubscriber", "/ear", "/chatter", STRING, EAR),
        ("registerSubscriber", "/late", "/chatter", STRING, Api("late")),
        ("registerPublisher", "/third", "/chatter", STRING, Api("third")),
        ("unregisterSubscriber", "/ear", "/chatter", TALKER),
        ("unregisterSubscriber", "/ear", "/nothing", EAR),
        ("unregisterSubscriber", "/ear", "/chatter", EAR),
        ("lookupNode", TESTER, "/ear"),
    ],
    "publisher and subscriber of one topic": [
        ("registerPublisher", "/both", "/loop", STRING, Api("both")),
        ("registerSubscriber", "/both", "/loop", STRING, Api("both")),
        ("registerPublisher", "/talker", "/loop", STRING, TALKER),
        ("unregisterPublisher", "/both", "/loop", Api("both")),
    ],
    "service": [
        ("registerService", "/server", "/negate", ServiceApi(4000), Api("server")),
        ("lookupService", TESTER, "/negate"),
        ("lookupService", TESTER, "negate"),
        ("lookupNode", TESTER, "/server"),
        ("registerService", "/server", "/add", ServiceApi(4000), Api("server")),
        ("unregisterService", "/server", "/negate", ServiceApi(4001)),
        ("unregisterService", "/nobody", "/negate", ServiceApi(4000)),
        ("unregisterService", "/server", "/nothing", ServiceApi(4000)),
        ("lookupService", TESTER, "/negate"),
        ("unregisterService", "/server", "/negate", ServiceApi(4000)),
        ("lookupService", TESTER, "/negate"),
        ("lookupNode", TESTER, "/server"),
        ("unregisterService", "/server", "/add", ServiceApi(4000)),
        ("lookupNode", TESTER, "/server"),
    ],
    "a service is the last one's who registered it": [
        ("registerService", "/server", "/negate", ServiceApi(4000), Api("server")),
        ("registerService", "/other", "/negate", ServiceApi(4100), Api("other")),
        ("unregisterService", "/server", "/negate", ServiceApi(4000)),
        ("lookupService", TESTER, "/negate"),
        ("unregisterService", "/other", "/negate", ServiceApi(4100)),
        ("lookupService", TESTER, "/negate"),
    ],
    "a second node of the name": [
        ("registerPublisher", "/talker", "/chatter", STRING, TALKER),
        ("registerSubscriber", "/talker", "/orders", STRING, TALKER),
        ("registerService", "/talker", "/negate", ServiceApi(4000), TALKER),
        ("subscribeParam", "/talker", TALKER, "/speed"),
        ("registerSubscriber", "/ear", "/chatter", STRING, EAR),
        ("registerPublisher", "/talker", "/other", STRING, Api("talker", 2)),
        ("lookupNode", TESTER, "/talker"),
        ("lookupService", TESTER, "/negate"),
        ("registerPublisher", "/talker", "/chatter", STRING, Api("talker", 2)),
    ],
    "relative and private names": [
        ("registerPublisher", "/left/talker", "chatter", STRING, TALKER),
        ("registerPublisher", "/left/talker", "~status", STRING, TALKER),
        ("registerPublisher", "/left/talker", "//odd///name/", STRING, TALKER),
        ("registerSubscriber", "/left/ear", "chatter", STRING, EAR),
        ("registerService", "/left/talker", "negate", ServiceApi(4000), TALKER),
        ("registerService", "/left/talker", "~reset", ServiceApi(4000), TALKER),
        ("lookupService", "/left/someone", "negate"),
        ("lookupService", "/someone", "left/negate"),
        ("lookupService", "/left/talker", "~reset"),
        ("lookupNode", "/left/someone", "talker"),
        ("lookupNode", "/someone", "talker"),
        ("getPublishedTopics", "/left/someone", "talker"),
        ("getPublishedTopics", "/someone", "left"),
        ("getPublishedTopics", "/someone", "/left/"),
        ("getPublishedTopics", "/someone", "/lef"),
        ("unregisterPublisher", "/left/talker", "chatter", TALKER),
        ("unregisterService", "/left/talker", "~reset", ServiceApi(4000)),
    ],
    "who nobody knows": [
        ("lookupNode", TESTER, "/nobody"),
        ("lookupService", TESTER, "/nothing"),
        ("unregisterSubscriber", "/nobody", "/chatter", Api("nobody")),
        ("unregisterService", "/nobody", "/nothing", ServiceApi(4000)),
        ("unsubscribeParam", "/nobody", Api("nobody"), "/a"),
    ],
    "a tool without a name": [
        ("getSystemState", ""),
        ("getPublishedTopics", "", ""),
        ("getPublishedTopics", "", "left"),
        ("getParam", "", "run_id"),
        ("lookupNode", "", "rosout"),
    ],
}


@pytest.mark.parametrize("method", NO_CALLER)
def test_call_without_a_caller(both: BothMasters, method: str) -> None:
    """A call without arguments is an error of the caller, with the text that every ROS tool knows."""
    answers = both.call(method)
    assert differences(answers) == []
    assert answers.appliance[:2] == [-1, "missing required caller_id parameter"]


@pytest.mark.parametrize("step", TOO_FEW_OR_MANY, ids=repr)
def test_wrong_number_of_arguments(both: BothMasters, step: Step) -> None:
    """Too few or too many arguments are an error of the caller."""
    answers = both.call(*step)
    assert differences(answers) == []
    assert answers.appliance[:2] == [-1, "Error: bad call arity"]


@pytest.mark.parametrize("step", WRONG_ARGUMENTS, ids=repr)
def test_wrong_arguments(both: BothMasters, step: Step) -> None:
    """An empty argument, or one of a wrong type or form, is an error of the caller that names the argument."""
    answers = both.call(*step)
    assert answers.appliance[0] == -1
    assert differences(answers) == []


@pytest.mark.parametrize("name", SEQUENCES)
def test_sequence(both: BothMasters, name: str) -> None:
    """Both masters answer every call of the sequence alike, and have the same whole state after each."""
    for step in SEQUENCES[name]:
        assert differences(both.call(*step)) == [], step
        assert differences(both.call("getSystemState", TESTER)) == [], f"the state after {step}"


def test_nodes_get_the_same_updates(both: BothMasters) -> None:
    """Subscribers get the same final lists, watchers of a parameter the same updates, a replaced node its shutdown."""

    def of_interest(call: NodeCalled) -> bool:
        return call.method in {"paramUpdate", "shutdown"}

    def updated(side: MasterSide, changes: int) -> bool:
        return sum(call.method == "paramUpdate" for call in side.nodes.all_calls()) >= changes

    changes = 0
    for step in (
        ("registerSubscriber", "/ear", "/chatter", STRING, EAR),
        ("registerPublisher", "/talker", "/chatter", STRING, TALKER),
        ("registerPublisher", "/second", "/chatter", STRING, Api("second")),
        ("subscribeParam", "/ear", EAR, "/arm"),
        ("setParam", TESTER, "/arm/speed", 1),
        ("setParam", TESTER, "/arm", {"speed": 2, "joint": {"left": 3}}),
        ("setParam", "/ear", "/arm/speed", 4),
        ("deleteParam", TESTER, "/arm/speed"),
        ("registerPublisher", "/second", "/chatter", STRING, Api("second", 2)),
        ("unregisterPublisher", "/talker", "/chatter", TALKER),
    ):
        assert differences(both.call(*step)) == []
        # `rosmaster` sends its updates later, in a thread, so the value of an update may already include the next
        # change.
        changes += step[0] in {"setParam", "deleteParam"} and step[1] == TESTER
        for side in (both.plain, both.appliance):
            assert side.nodes.wait_until(partial(updated, side, changes))

    def settled() -> bool:
        answers = both.calls_made(of_interest)
        # A plain master sends with three threads: its calls overtake each other, so the order is not compared.
        plain, ours = (
            {node: sorted(map(repr, calls)) for node, calls in one.items()}
            for one in (answers.plain, answers.appliance)
        )
        return plain == ours and {"ear-1", "second-1"} <= plain.keys()

    assert both.appliance.nodes.wait_until(settled) or settled(), both.calls_made(of_interest)
    for side in (both.plain, both.appliance):
        assert side.nodes.wait_until(lambda side=side: side.last_list(EAR, "/chatter") == ["<second>"])  # type: ignore[misc]  # mypy does not infer a lambda with defaults


def test_own_address(both: BothMasters) -> None:
    """`getUri` returns the address by which the caller knows the master; `getPid` returns a process id."""
    assert both.call("getUri", TESTER).appliance == [1, "", "<master>"]
    assert both.appliance.call("getUri", [TESTER])[2] == both.appliance.uri + "/"
    answers = both.call("getPid", TESTER)
    assert [type(one) for one in answers.appliance] == [type(one) for one in answers.plain]


def test_unknown_call_is_denied(both: BothMasters) -> None:
    """A plain master answers with a fault, the appliance with a denial and its reason; client libraries accept both."""
    for method in ("getNothing", "_shutdown", "done", "reg_manager.nodes", "publisherUpdate"):
        answers = both.call(method, TESTER)
        assert isinstance(answers.plain, Fault)
        code, message, value = answers.appliance
        assert (code, value) == (0, 0)
        assert "is not a call that is served here" in message


def test_multicall_parts_run_in_order(both: BothMasters) -> None:
    """roslaunch clears and sets parameters in one multicall: each part sees the result of the part before it."""
    parts = [
        {"methodName": method, "params": [TESTER, *params]}
        for number in range(200)
        for method, *params in (
            ("setParam", "/order", {"number": number, "text": "x" * (number % 7)}),
            ("getParam", "/order/number"),
            ("deleteParam", "/order"),
            ("hasParam", "/order"),
            ("setParam", f"/kept/p{number}", number),
        )
    ]
    answers = both.call("system.multicall", parts)
    assert answers.plain == answers.appliance
    assert differences(both.call("getParamNames", TESTER)) == []


def test_multicall(both: BothMasters) -> None:
    """`system.multicall` answers each part like a single call; roslaunch sets its parameters this way."""
    parts = [
        {"methodName": "setParam", "params": [TESTER, "/launch/a", 1]},
        {"methodName": "setParam", "params": [TESTER, "/launch/b", {"c": [True, "x"]}]},
        {"methodName": "getParam", "params": [TESTER, "/launch"]},
        {"methodName": "getParam", "params": [TESTER, "/nothing"]},
        {"methodName": "getPid", "params": []},
    ]
    answers = both.call("system.multicall", parts)
    assert answers.plain == answers.appliance
    assert answers.appliance[2] == [[1, "Parameter [/launch]", {"a": 1, "b": {"c": [True, "x"]}}]]
    assert both.call("system.multicall", []).appliance == []


@pytest.mark.parametrize(
    "given",
    [(), (5,), ([5],), ([{}],), ([{"methodName": "getPid"}],), ([{"methodName": "getPid", "params": 5}],)],
)
def test_multicall_with_malformed_parts(both: BothMasters, given: tuple[Any, ...]) -> None:
    """A malformed list of calls, or one malformed part, is an error only for its sender."""
    answers = both.call("system.multicall", *given)
    wrong = answers.appliance[0] == -1 or all("faultCode" in part for part in answers.appliance)
    assert wrong, answers
    assert both.call("getPid", TESTER).appliance[0] == 1


@pytest.mark.parametrize(
    "step",
    [
        ("getPid", "no_slash"),
        ("getPid", "/wörld"),
        ("setParam", "", "/a", 1),
        ("registerPublisher", "/talker", "/with-dash", STRING, TALKER),
        ("registerPublisher", "/talker", "/dot.ted", STRING, TALKER),
        ("registerPublisher", "/talker", "1st", STRING, TALKER),
        ("registerPublisher", "/talker", "/chatter", "std_msgs/", TALKER),
        ("registerPublisher", "/talker", "/chatter", STRING, "http://"),
        ("registerPublisher", "/talker", "/chatter", STRING, "http://127.0.0.1/"),
        ("registerPublisher", "/talker", "/chatter", STRING, ServiceApi(4000)),
        ("registerService", "/talker", "/negate", TALKER, TALKER),
        ("getParam", TESTER, "/what?"),
        ("getPublishedTopics", TESTER, "/a b"),
    ],
    ids=repr,
)
def test_calls_that_only_the_appliance_rejects(both: BothMasters, step: Step) -> None:
    """Names outside the ROS grammar and URIs without an address are an error of the caller (docs/limits.md)."""
    answers = both.call(*step)
    assert answers.plain[0] in (1, -1)
    code, message, value = answers.appliance
    assert (code, type(value)) == (-1, type(both.call(step[0]).appliance[2]))
    assert len(message) > 20
