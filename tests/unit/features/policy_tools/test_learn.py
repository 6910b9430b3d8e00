import ipaddress
import re
import string
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.features.policy_tools.learn import LearnedPolicy, Observation, is_covered, learn, needed_rights
from appliance.master.calls.call import RosCall
from appliance.policy.cases import run_cases
from appliance.policy.commands import COMMANDS
from appliance.policy.keys import is_parameter_key
from appliance.policy.model import Category, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import Right, decide, decide_right, rights_of, rights_of_call
from appliance.policy.sections import DECIDERS, PARAMETERS
from roswire.xmlrpc import Value
from tests.unit.features.policy_tools.test_rights import KEY_GIVEN, NAME, ROWS, deeds, gate_says

ROBOT = ipaddress.ip_address("192.0.2.10")
HOSTS = [ipaddress.ip_address(text) for text in ("10.0.0.1", "10.0.0.2", "fd00::5", "192.0.2.10")]
NAMES = [
    "/a", "/a/b", "/a/b/c", "/cmd_vel", "/a_1", "/tool_4711_1700000000000", "/tool_99_1700000000001/x", "/tool_1",
    "/tool_99_1700000000001/x/y", "/tool_1/x_4_1700000000001/b", "/tool_1/x_a", "/roslaunch/uris/host_a__1",
]  # fmt: skip


def seen(
    host: str, category: Category, resource: str, *, node: str = "/n", call: str = "", key: str = ""
) -> Observation:
    return Observation(Request(ipaddress.ip_address(host), node, category, resource), call, key)


def compiled(learned: LearnedPolicy) -> Policy:
    return compile_policy(learned.text, file="learned", robot=[ROBOT])


def test_only_observed_requests_are_granted() -> None:
    policy = compiled(learn([seen("10.0.0.1", Category.PUBLISH, "/cmd_vel", node="/joy")]))
    host, other = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")
    assert decide(policy, rights_of(Request(host, "/joy", Category.PUBLISH, "/cmd_vel"))).allowed
    for request in (
        Request(other, "/joy", Category.PUBLISH, "/cmd_vel"),
        Request(host, "/joy2", Category.PUBLISH, "/cmd_vel"),
        Request(host, "/joy", Category.SUBSCRIBE, "/cmd_vel"),
        Request(host, "/joy", Category.PUBLISH, "/cmd_vel/x"),
        Request(host, "/joy", Category.COMMAND, "shutdown"),
        Request(host, "/joy", Category.OFFER, "/s"),
        Request(host, "/joy", Category.CALL, "/s"),
        Request(host, "/joy", Category.READ, "/p"),
        Request(host, "/joy", Category.WRITE, "/p"),
    ):
        assert not decide(policy, rights_of(request)).allowed, request


def test_a_search_for_a_parameter_may_find_it_the_next_time() -> None:
    learned = learn([
        seen("10.0.0.1", Category.COMMAND, "searchParam", node="/arm/driver", call="searchParam", key="tf_prefix")
    ])  # fmt: skip
    policy = compiled(learned)
    host, other = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")
    for name in ("/arm/driver/tf_prefix", "/arm/tf_prefix", "/tf_prefix"):
        assert policy.decide(Request(host, "/arm/driver", Category.READ, name)).allowed
        assert not policy.decide(Request(other, "/arm/driver", Category.READ, name)).allowed
    assert not policy.decide(Request(host, "/arm/driver", Category.READ, "/arm/gain")).allowed
    assert not policy.decide(Request(host, "/arm/driver", Category.WRITE, "/tf_prefix")).allowed


@pytest.mark.parametrize(
    ("given", "robot", "expected"),
    [
        ("172.17.0.1/32", ["172.17.0.1/32"], True),
        ("192.168.1.10/32", ["172.17.0.1/32"], False),
        ("192.168.1.10/32", [], False),
        ("10.0.0.0/30", ["10.0.0.0/24", "fd00::/8"], True),
        ("10.0.0.0/16", ["10.0.0.0/24"], False),
        ("::1/128", ["127.0.0.1/32", "::1/128"], True),
    ],
)
def test_only_the_appliances_own_robot_is_its_group(given: str, robot: list[str], expected: bool) -> None:
    assert is_covered(ipaddress.ip_network(given), map(ipaddress.ip_network, robot)) == expected


def test_anonymous_names_become_patterns() -> None:
    listener = "/listener_1700000000123456789"
    learned = learn([
        seen("10.0.0.1", Category.SUBSCRIBE, "/chatter", node="/rostopic_4711_1700000000000"),
        seen("10.0.0.1", Category.OFFER, f"{listener}/get_loggers", node=listener),
    ])  # fmt: skip
    policy = compiled(learned)
    host = ipaddress.ip_address("10.0.0.1")
    for node in ("/rostopic_1_1800000000000", "/listener_1800000000123456789"):
        assert policy.decide(Request(host, node, Category.NODE, node)).allowed
    assert policy.decide(
        Request(host, "", Category.OFFER, "/listener_1800000000123456789/get_loggers")
    ).allowed
    assert not policy.decide(Request(host, "", Category.NODE, "/rostopic")).allowed
    assert "/a_1 " in learn([seen("10.0.0.1", Category.PUBLISH, "/a_1")]).text


ONE_RUN = {
    "rospy": ("/pose_4711_1700000000000", "/pose_12_1800000000001"),
    "roscpp": ("/rviz_1700000000123456789", "/rviz_1800000000123456789"),
    "anon": ("/listener_robot_4711_8329475019283746501", "/listener_robot_12_1029384756102938475"),
    "rqt": ("/rqt_gui_py_node_4711", "/rqt_gui_py_node_12"),
    "rqt in C++": ("/rqt_gui_cpp_node_4711", "/rqt_gui_cpp_node_12"),
}


def a_launch(node: str, port: int) -> list[Observation]:
    """Return what a `roslaunch` and its node do."""
    uri = f"/roslaunch/uris/host_robot__{port}"
    sets = [
        seen("10.0.0.1", Category.COMMAND, call, node="/roslaunch", call=call, key=key)
        for call, key in (("setParam", uri), ("deleteParam", node), ("setParam", f"{node}/rate/max"))
    ]
    gets = [
        seen("10.0.0.1", Category.COMMAND, call, node=node, call=call, key=key)
        for call, key in (("getParam", node), ("getParam", f"{node}/rate"), ("searchParam", "tf_prefix"))
    ]
    return [
        *sets,
        *gets,
        seen("10.0.0.1", Category.NODE, node, node=node),
        seen("10.0.0.1", Category.PUBLISH, f"{node}/out", node=node),
        seen("10.0.0.1", Category.SUBSCRIBE, f"{node}/in", node=node),
        seen("10.0.0.1", Category.OFFER, f"{node}/get_loggers", node=node),
        seen("10.0.0.1", Category.CALL, f"{node}/get_loggers", node="/rqt_gui_py_node_7"),
    ]


@pytest.mark.parametrize("namespace", ["", "/arm"])
@pytest.mark.parametrize("names", ONE_RUN.values(), ids=ONE_RUN)
def test_the_next_run_passes_with_its_own_names(names: tuple[str, str], namespace: str) -> None:
    first, second = (
        a_launch(namespace + name, port) for name, port in zip(names, (42311, 50001), strict=True)
    )
    learned = learn(first)
    policy = compiled(learned)
    for right in (request for observation in second for request in needed_rights(observation)):
        assert decide_right(policy, Right(right, namespace=right.category in PARAMETERS)).allowed, right
        other = replace(right, host=HOSTS[1])
        assert not policy.decide(other).allowed, right
    assert not re.search("4711|1700000000|42311", learned.text)
    assert all(result.passed for result in run_cases(policy, learned.tests, "tests"))


@pytest.mark.parametrize(
    "name", ["/arm_2", "/camera_20240101", "/rqt_gui_py_node", "/my_rqt_gui_py_node_2", "/a_1_2"]
)
def test_a_name_that_lasts_is_its_own_key(name: str) -> None:
    learned = learn([*a_launch(name, 42311), *a_launch(ONE_RUN["rospy"][0], 42311)])
    policy = compiled(learned)
    other = f"{name}3"
    for category in (Category.NODE, Category.PUBLISH, Category.READ, Category.WRITE):
        below = f"{other}/out" if category is Category.PUBLISH else other
        assert not policy.decide(Request(HOSTS[0], other, category, below)).allowed


def test_a_name_of_one_run_may_be_beside_names_that_look_alike() -> None:
    anonymous = "/talker_4711_1700000000000"
    topics = (("10.0.0.1", "/talker_1"), ("10.0.0.2", anonymous))
    own = (("10.0.0.1", f"{anonymous}/rate"), ("10.0.0.2", f"{anonymous}/rate/max"))
    keys = (*own, ("10.0.0.1", "/talker_1/rate"))
    learned = learn([
        *(seen(host, Category.PUBLISH, topic) for host, topic in topics),
        *(seen(host, Category.COMMAND, "getParam", call="getParam", key=key) for host, key in keys),
    ])  # fmt: skip
    assert all(result.passed for result in run_cases(compiled(learned), learned.tests, "tests"))


def test_a_parameter_call_needs_the_call_and_the_key() -> None:
    policy = compiled(learn([
        seen("10.0.0.1", Category.COMMAND, "getParam", call="getParam", key="/arm"),
        seen("10.0.0.2", Category.COMMAND, "getParam", call="getParam", key="/arm/max"),
        seen("10.0.0.2", Category.COMMAND, "setParam", call="setParam", key="/arm/max"),
    ]))  # fmt: skip
    one, two = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")
    for host, category, key, allowed in (
        (one, Category.READ, "/arm", True), (one, Category.READ, "/arm/max", True),
        (two, Category.READ, "/arm/max", True), (two, Category.READ, "/arm", False),
        (two, Category.WRITE, "/arm/max", True), (one, Category.WRITE, "/arm/max", False),
    ):  # fmt: skip
        request = Request(host, "/n", category, key)
        assert policy.decide_parameter(request, namespace=True).allowed is allowed, request
    assert policy.decide(Request(one, "/n", Category.COMMAND, "getParam")).allowed
    assert not policy.decide(Request(one, "/n", Category.COMMAND, "setParam")).allowed


def test_the_robot_is_called_robot() -> None:
    """With the group, the policy remains valid if the robot gets another address."""
    learned = learn(
        [seen("192.0.2.10", Category.PUBLISH, "/a"), seen("10.0.0.1", Category.PUBLISH, "/a")], [ROBOT]
    )
    assert "/a = robot 10.0.0.1" in learned.text
    assert "192.0.2.10" not in learned.text


def test_hosts_that_are_named_together_are_a_group() -> None:
    learned = learn([
        seen(host, Category.PUBLISH, topic, node="/joy")
        for host in ("10.0.0.1", "10.0.0.2") for topic in ("/a", "/b", "/a")
    ] + [seen("10.0.0.1", Category.SUBSCRIBE, "/c", node="/joy")], [ROBOT])  # fmt: skip
    lines = learned.text.splitlines()
    assert lines[lines.index("[Groups]") + 1] == "hosts-1 = 10.0.0.1 10.0.0.2"
    assert "/a = hosts-1  # /joy (4x)" in lines
    assert "/b = hosts-1  # /joy (2x)" in lines
    assert "/c = 10.0.0.1  # /joy (1x)" in lines
    policy = compiled(learned)
    assert policy.decide(Request(HOSTS[1], "/joy", Category.PUBLISH, "/b")).allowed
    assert not policy.decide(Request(HOSTS[1], "/joy", Category.SUBSCRIBE, "/c")).allowed


def test_a_parameter_is_left_out_where_the_one_above_says_the_same() -> None:
    learned = learn([
        seen(host, Category.COMMAND, "getParam", call="getParam", key=key)
        for host, key in (("10.0.0.1", "/arm"), ("10.0.0.1", "/arm/max"), ("10.0.0.2", "/arm/min"))
    ])  # fmt: skip
    keys = [line.split()[1] for line in learned.text.splitlines() if line.startswith("read ")]
    assert keys == ["/arm/**", "/arm/min/**"]


@pytest.mark.parametrize(
    ("category", "resource"),
    [(Category.COMMAND, "noSuchCall"), (Category.COMMAND, "registerPublisher"), (Category.PUBLISH, "no slash"),
     (Category.PUBLISH, "/a\n[Commands]\ndefault = *"), (Category.PUBLISH, "/a = *  #"), (Category.NODE, "/é")],
)  # fmt: skip
def test_text_of_unknown_hosts_never_becomes_a_rule(category: Category, resource: str) -> None:
    learned = learn([seen("10.0.0.1", category, resource), seen("10.0.0.1", Category.PUBLISH, "/ok")])
    assert (learned.requests, learned.left_out) == (1, 1)
    assert resource not in learned.text
    evil = learn([seen("10.0.0.1", Category.COMMAND, "getPid", node="/x\ndefault = *")])
    assert "default" not in evil.text


_PARAMETERS = [
    name
    for character in string.printable.replace("/", "")
    for name in (f"/arm/a{character}b", f"/arm/a{character} b", f"/arm/a{character}")
    if is_parameter_key(name)
]


@pytest.mark.parametrize("name", [*_PARAMETERS, "/arm/a = 10.9.9.9 #y", "/arm/a = 0.0.0.0/0 ;"])
def test_a_name_of_a_parameter_is_a_key_as_it_is_or_left_out(name: str) -> None:
    learned = learn([
        seen("10.0.0.1", Category.COMMAND, "setParam", call="setParam", key=key) for key in ("/arm/a", name)
    ])  # fmt: skip
    policy = compiled(learned)
    keys = {rule.rule.key for rule in policy.rules(Category.WRITE)}
    assert keys == {"write /arm/a/**"} | ({f"write {name}/**"} if not learned.left_out else set())
    assert learned.left_out == any(character in name for character in "#;=")
    assert all(result.passed for result in run_cases(policy, learned.tests, "tests"))


_observations = st.builds(
    lambda host, node, what: Observation(Request(host, node, what[0], what[1]), what[2], what[3]),
    st.sampled_from(HOSTS),
    st.sampled_from(NAMES),
    st.one_of(
        st.tuples(
            st.sampled_from([Category.PUBLISH, Category.SUBSCRIBE, Category.OFFER, Category.NODE]),
            st.sampled_from(NAMES), st.just(""), st.just(""),
        ),
        st.tuples(st.just(Category.CALL), st.sampled_from(NAMES), st.just("lookupService"), st.just("")),
        st.tuples(st.just(Category.COMMAND), st.sampled_from(sorted(COMMANDS)), st.just(""), st.just("")),
        st.sampled_from(["getParam", "hasParam", "subscribeParam", "setParam", "deleteParam"]).flatmap(
            lambda call: st.tuples(
                st.just(Category.COMMAND), st.just(call), st.just(call), st.sampled_from([*NAMES, "/"])
            )
        ),
    ),
)  # fmt: skip


@given(st.lists(_observations, min_size=1, max_size=40))
def test_the_same_run_passes_under_what_was_learned(observations: list[Observation]) -> None:
    policy = compiled(learn(observations, [ROBOT]))
    for observation in observations:
        rights = rights_of_call(observation.request, observation.call, observation.key or None)
        assert decide(policy, rights).allowed, (observation, policy.text)


@given(st.lists(_observations, min_size=1, max_size=40))
def test_the_learned_tests_pass_and_an_open_policy_fails_them(observations: list[Observation]) -> None:
    learned = learn(observations, [ROBOT], {"10.0.0.1": "base.local", "10.0.0.2": "base", "fd00::5": "ask"})
    assert all(result.passed for result in run_cases(compiled(learned), learned.tests, "tests"))
    keys = {Category.READ: "read default", Category.WRITE: "write default"}
    everyone = "\n".join(
        f"[{decider.name}]\n"
        + "\n".join(f"{keys.get(category, 'default')} = *" for category in decider.categories)
        for decider in DECIDERS
    )
    results = run_cases(compile_policy(everyone, file="open", robot=[ROBOT]), learned.tests, "tests")
    assert [result.expected for result in results if not result.passed].count("deny") > 0


def test_a_host_has_its_name_of_the_hosts_file_unless_it_is_taken() -> None:
    names = {"10.0.0.1": "base.example", "10.0.0.2": "base", "fd00::5": "robot"}
    learned = learn(
        [seen(host, Category.PUBLISH, "/a") for host in ("10.0.0.1", "10.0.0.2", "fd00::5")], (), names
    )
    assert "base = 10.0.0.1\n" in learned.text
    assert "/a = " in learned.text
    assert decide(compiled(learned), rights_of(Request(HOSTS[0], "/n", Category.PUBLISH, "/a"))).allowed
    assert "robot" not in learned.text


def test_the_log_levels_of_all_nodes_are_one_key() -> None:
    learned = learn([
        seen("10.0.0.1", Category.OFFER, f"{node}/{service}", node=node)
        for node in ("/a", "/b", "/arm/driver") for service in ("get_loggers", "set_logger_level")
    ])  # fmt: skip
    (section,) = (text for text in learned.text.split("\n\n") if text.startswith("[Services]"))
    assert [line.split()[0] for line in section.splitlines()[1:]] == [
        "/*/get_loggers", "/*/set_logger_level", "/arm/driver/get_loggers", "/arm/driver/set_logger_level",
    ]  # fmt: skip
    policy = compiled(learned)
    assert not policy.decide(Request(HOSTS[1], "/a", Category.OFFER, "/a/get_loggers")).allowed


_ADOPTED = Observation(
    Request(HOSTS[0], "/arm", Category.PUBLISH, "/state"), "registerPublisher", adopted=True
)
_STARTED = Observation(Request(HOSTS[1], "/joy", Category.PUBLISH, "/joy"), "registerPublisher")


def test_a_node_that_was_only_taken_over_was_not_seen_to_start() -> None:
    assert learn([_ADOPTED, _STARTED]).unstarted == ("/arm",)
    started = replace(_ADOPTED, adopted=False)
    assert learn([_ADOPTED, started, _STARTED]).unstarted == ()


def test_the_rights_of_a_start_are_granted_to_that_host_only() -> None:
    """The calls that an unmodified node and its `roslaunch` make at a start pass; another host gains nothing."""
    learned = learn([_ADOPTED, _STARTED], with_start=True)
    policy = compiled(learned)
    assert "# Not seen to start: /arm." in learned.text
    calls = (
        ("hasParam", "/use_sim_time"), ("getParam", "/arm/gain"), ("setParam", "/roslaunch/x"), ("setParam", "/run_id"),
    )  # fmt: skip
    for call, key in calls:
        for host, allowed in ((HOSTS[0], True), (HOSTS[1], False)):
            request = Request(host, "/arm", Category.COMMAND, call)
            assert decide(policy, rights_of_call(request, call, key)).allowed is allowed, (call, host)


@given(st.lists(_observations, min_size=1, max_size=20), _observations)
def test_a_host_that_did_nothing_may_do_nothing(observations: list[Observation], other: Observation) -> None:
    policy = compiled(learn(observations, [ROBOT]))
    unknown = Request(
        ipaddress.ip_address("203.0.113.9"), "/n", other.request.category, other.request.resource
    )
    assert not decide(policy, rights_of(unknown)).allowed


def test_a_right_that_needed_an_approval_is_learned_behind_ask() -> None:
    request = Request(HOSTS[0], "/it", Category.PUBLISH, "/cmd_vel")
    learned = learn([Observation(request, "registerPublisher", asked=True)]).text
    assert "/cmd_vel = ask 10.0.0.1" in learned
    assert "[Nodes]\n/it = 10.0.0.1" in learned
    assert not compile_policy(learned, file="learned").decide(request).allowed


@pytest.mark.parametrize("call", ROWS, ids=lambda one: one.name)
@pytest.mark.parametrize(
    "tree", [{}, {"arm": {"speed": 1}}, {"arm": {"speed": {"max": 1}}}], ids=["empty", "value", "namespace"]
)
def test_a_policy_learned_from_a_call_grants_it(call: RosCall[Any], tree: dict[str, Value]) -> None:
    key = KEY_GIVEN if call.row.touches is not None else ""
    learned = learn([Observation(deeds(call)[0], call.name, key)])
    assert not learned.left_out
    policy = compile_policy(learned.text, file="learned")
    assert gate_says(policy, call, tree).allowed
    other = Request(ipaddress.ip_address("10.0.0.66"), NAME, call.row.category, deeds(call)[0].resource)
    assert not decide(policy, rights_of(other)).allowed
