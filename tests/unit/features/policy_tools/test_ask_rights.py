from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from ipaddress import ip_address

import pytest
import yaml

from appliance.features.policy_tools.learn import lasting_name, needed_rights
from appliance.features.policy_tools.learn_verb import Answer, AskedPolicy, RightKind, carry_out
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Category, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import Right, decide_right
from tests.unit.features.policy_tools.test_learn import ONE_RUN, a_launch

ROBOT, PAD = ip_address("192.0.2.1"), ip_address("10.0.0.5")
KNOWN = PolicyContext(robot=[ROBOT])
TEXT = """[Nodes]
default = robot
[Publishers]
default = robot
[Subscribers]
default = robot
[Commands]
default = robot
[Services]
default = robot
[Clients]
default = robot
[Parameters]
read default = robot
write default = robot
[Options]
audit-only = all
"""
MOVE = RightKind(Category.PUBLISH, "/base/cmd_vel", PAD)
LIGHT = RightKind(Category.PUBLISH, "/base/light", PAD)
TOOL = RightKind(Category.NODE, "/rostopic_*", PAD)
SCAN = RightKind(Category.SUBSCRIBE, "/scan", ROBOT)


def asked(text: str = TEXT, cases: Sequence[object] = ()) -> AskedPolicy:
    return AskedPolicy(text, "p.ini", KNOWN, cases=list(cases))


def counts(*kinds: RightKind) -> Counter[tuple[RightKind, str]]:
    return Counter({(kind, "/pad"): number for number, kind in enumerate(kinds, start=1)})


def answered(policy: AskedPolicy, *kinds: RightKind, **replies: Answer) -> list[str]:
    """Answer by the last part of the name, and return what was asked."""
    questions: list[str] = []
    written: list[str] = []

    def answer(kind: RightKind, _node: str, _count: int) -> Answer:
        questions.append(kind.name)
        return replies.get(kind.name.rpartition("/")[2].strip("_*"), "later")

    carry_out(policy, counts(*kinds), answer, lambda: written.append(policy.text))
    acts = [replies.get(name.rpartition("/")[2].strip("_*")) for name in questions]
    assert len(written) == sum(act in ("allow", "wider", "deny") for act in acts)
    return questions


def compiled(policy: AskedPolicy) -> Policy:
    return compile_policy(policy.text, file="p.ini", robot=[ROBOT])


def may(policy: AskedPolicy, kind: RightKind, name: str = "") -> bool:
    decision = compiled(policy).decide(
        Request(kind.host, "/pad", kind.category, name or kind.name.replace("*", "7"))
    )
    return decision.allowed and not decision.would_deny


def test_only_what_the_rules_deny_is_asked_also_in_audit_only_mode() -> None:
    assert answered(asked(), SCAN, MOVE) == ["/base/cmd_vel"]
    assert answered(asked(TEXT.replace("audit-only = all\n", "")), SCAN, MOVE) == ["/base/cmd_vel"]


def test_an_address_of_the_machine_has_the_rights_of_the_robot() -> None:
    own = AskedPolicy(TEXT, "p.ini", replace(KNOWN, own=[PAD]))
    assert list(own.missing(counts(MOVE, SCAN))) == []
    own.deny(MOVE, "/pad")
    assert own.cases == [{"host": "robot", "node": "/pad", "deny": ["publish /base/cmd_vel"]}]
    assert own.given == {"robot": [str(ROBOT), str(PAD)]}


def test_an_allowed_right_is_that_hosts_alone() -> None:
    policy = asked()
    answered(policy, MOVE, LIGHT, TOOL, cmd_vel="allow", rostopic="allow")
    assert may(policy, MOVE) and may(policy, TOOL) and not may(policy, LIGHT)
    assert not may(policy, RightKind(Category.PUBLISH, "/base/cmd_vel", ip_address("10.0.0.6")))
    policy.judge()


@pytest.mark.parametrize("names", ONE_RUN.values(), ids=ONE_RUN)
def test_a_name_that_was_allowed_for_one_run_is_allowed_for_the_next(names: tuple[str, str]) -> None:
    first, second = (a_launch(name, port) for name, port in zip(names, (42311, 50001), strict=True))
    needed = [request for observation in first for request in needed_rights(observation)]
    kinds = [RightKind(request.category, lasting_name(request), request.host) for request in needed]
    policy = asked(TEXT.replace("audit-only = all\n", ""))
    carry_out(policy, counts(*kinds), lambda *_: "allow", lambda: None)
    for request in (request for observation in second for request in needed_rights(observation)):
        assert decide_right(compiled(policy), Right(request)).allowed, request


def test_a_wider_answer_covers_the_next_question() -> None:
    policy = asked()
    assert answered(policy, MOVE, LIGHT, cmd_vel="wider") == ["/base/cmd_vel"]
    assert may(policy, LIGHT) and not may(policy, LIGHT, "/arm/light")


def test_a_denied_right_is_a_test_case_and_is_not_asked_again() -> None:
    policy = asked()
    assert answered(policy, MOVE, cmd_vel="deny") == ["/base/cmd_vel"]
    policy.judge()
    again = asked(policy.text, policy.cases)
    assert answered(again, MOVE) == []
    again.text = again.text.replace("[Nodes]\n", "[Nodes]\n/pad = 10.0.0.5\n")
    again.text = again.text.replace("[Publishers]\n", "[Publishers]\n/base/cmd_vel = robot 10.0.0.5\n")
    with pytest.raises(PolicyError, match="expected deny"):
        again.judge()


@pytest.mark.parametrize("node", ["", "/pad", "/rosparam-4711", "not a name", "/a:b #c"])
@pytest.mark.parametrize("category", Category)
def test_each_denied_right_is_a_case_that_the_next_run_reads(category: Category, node: str) -> None:
    names = {Category.COMMAND: "setParam", Category.WRITE: "/arm/a: b", Category.READ: "/arm/a - 'b"}
    kind = RightKind(category, names.get(category, "/x_*"), PAD)
    policy = asked()
    policy.deny(kind, node)
    policy.judge()
    again = asked(policy.text, yaml.load(policy.cases_text, yaml.BaseLoader)["cases"])  # noqa: S506  only texts
    assert list(again.missing(Counter({(kind, node): 1}))) == []
    again.judge()


def test_a_right_for_later_is_asked_again_and_quit_asks_no_more() -> None:
    policy = asked()
    assert answered(policy, MOVE, LIGHT) == ["/base/cmd_vel", "/base/light"]
    assert answered(policy, MOVE, LIGHT, cmd_vel="quit") == ["/base/cmd_vel"]
    assert policy.text == TEXT
