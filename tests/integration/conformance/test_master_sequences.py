"""Any sequence of Master API calls gets the answers of a plain ROS master, and leaves the same state.

Hypothesis makes the sequences from few names, so that nodes, topics and keys collide; the seed is fixed.
"""

from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.integration.conformance.side_by_side import TESTER, Api, BothMasters, ServiceApi, differences
from tests.support.examples import examples

Step = tuple[Any, ...]
NODES = st.sampled_from(["/talker", "/ear", "/left/arm", "/left/hand"])
NAMES = st.sampled_from(
    ["/chatter", "chatter", "~status", "/left/chatter", "left/chatter", "/a//b/", "/left"]
)
TYPES = st.sampled_from(["*", "std_msgs/String", "std_msgs/Bool"])
KEYS = st.sampled_from(
    ["/", "/arm", "/arm/speed", "arm", "speed", "~speed", "/left/arm", "/arm/speed/max", "//arm//"]
)
SERVICES = st.sampled_from([ServiceApi(4000), ServiceApi(4001)])
CALLERS = st.one_of(NODES, st.just(TESTER))
SCALARS = st.one_of(
    st.integers(-(2**31), 2**31 - 1),
    st.booleans(),
    st.floats(),
    st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=5),
)
SEGMENTS = st.sampled_from(["arm", "speed", "max", "left"])
VALUES = st.recursive(
    SCALARS,
    lambda below: st.one_of(st.lists(below, max_size=3), st.dictionaries(SEGMENTS, below, max_size=3)),
    max_leaves=6,
)
WRONG: st.SearchStrategy[Any] = st.sampled_from([None, "", 5, True, [], {}, ["/chatter"], 2.5])


@st.composite
def node_with_api(draw: st.DrawFn) -> tuple[str, Api]:
    node = draw(NODES)
    return node, Api(node.rpartition("/")[2])


@st.composite
def registrations(draw: st.DrawFn) -> Step:
    node, api = draw(node_with_api())
    method = draw(
        st.sampled_from(
            ["registerPublisher", "registerSubscriber", "unregisterPublisher", "unregisterSubscriber",
             "registerService", "unregisterService", "subscribeParam", "unsubscribeParam"]
        )
    )  # fmt: skip
    match method:
        case "registerPublisher" | "registerSubscriber":
            return method, node, draw(NAMES), draw(TYPES), api
        case "unregisterPublisher" | "unregisterSubscriber":
            return method, node, draw(NAMES), api
        case "registerService":
            return method, node, draw(NAMES), draw(SERVICES), api
        case "unregisterService":
            return method, node, draw(NAMES), draw(SERVICES)
    return method, node, api, draw(KEYS)


PARAMETERS = st.one_of(
    st.tuples(st.just("setParam"), CALLERS, KEYS.filter(lambda key: key != "/"), VALUES),
    st.tuples(st.sampled_from(["getParam", "hasParam", "deleteParam"]), CALLERS, KEYS),
    st.tuples(st.just("searchParam"), CALLERS, KEYS.filter(lambda key: not key.startswith("~"))),
)
LOOKUPS = st.one_of(
    st.tuples(st.just("lookupNode"), CALLERS, st.one_of(NODES, st.sampled_from(["talker", "arm", "nobody"]))),
    st.tuples(st.just("lookupService"), CALLERS, NAMES),
    st.tuples(st.just("getPublishedTopics"), CALLERS, st.one_of(NAMES, st.just(""))),
    st.tuples(st.sampled_from(["getTopicTypes", "getSystemState", "getParamNames"]), CALLERS),
)


@st.composite
def misformed(draw: st.DrawFn) -> Step:
    method, *arguments = draw(st.one_of(registrations(), PARAMETERS, LOOKUPS))
    match draw(st.sampled_from(["fewer", "more", "none", "wrong"])):
        case "fewer":
            return method, *arguments[:-1]
        case "more":
            return method, *arguments, draw(WRONG)
        case "none":
            return (method,)
    position = draw(st.integers(0, len(arguments) - 1))
    # A caller without a name may only read (docs/reference/limits.md), see `conversations/attacks.txt`.
    arguments[position] = draw(WRONG.filter(lambda wrong: position > 0 or wrong != ""))
    return method, *arguments


SEQUENCES = st.lists(
    st.one_of(registrations(), registrations(), PARAMETERS, PARAMETERS, LOOKUPS, misformed()),
    min_size=5,
    max_size=25,
)


@settings(
    max_examples=examples(120),
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(sequence=SEQUENCES)
def test_any_sequence(both: BothMasters, sequence: list[Step]) -> None:
    both.reset()
    for step in sequence:
        answers = both.call(*step)
        assert differences(answers) == [], step
    for look in (
        ("getSystemState", TESTER),
        ("getTopicTypes", TESTER),
        ("getParam", TESTER, "/"),
        ("getParamNames", TESTER),
    ):
        assert differences(both.call(*look)) == [], look
