import ipaddress

from appliance.features.policy_tools.decision_reasons import DecisionExplanation, explain, render
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import decide, rights_of
from tests.unit.policy.test_asking import AGENT
from tests.unit.policy.test_asking import policy as policy_that_asks
from tests.unit.policy.test_rate_limits import GUEST, policy

TEXT = """\
[Groups]
ocu = 10.0.0.5
[Nodes]
/ocu = ocu
[Publishers]
default = 10.0.0.1
/arm/** = ocu
/arm/* = 10.0.0.0/8
/arm/cmd = ocu
[Commands]
default = ocu
listMethods = 10.0.0.1
"""
POLICY = compile_policy(TEXT, file="p.ini")


def explained(host: str, category: Category, resource: str, node: str = "/ocu") -> DecisionExplanation:
    return explain(POLICY, Request(ipaddress.ip_address(host), node, category, resource))


def test_rules_that_lost_are_named_most_specific_first() -> None:
    explanation = explained("10.0.0.5", Category.PUBLISH, "/arm/cmd")
    assert explanation.decision.rule is not None
    assert explanation.decision.rule.key == "/arm/cmd"
    lost = [(one.rule.key, one.grants) for one in explanation.lost]
    assert lost == [("/arm/*", True), ("/arm/**", True), ("default", False)]
    assert explanation.lost[0].why == "/arm/cmd is more specific"


def test_the_word_that_matches_the_host_is_shown() -> None:
    assert explained("10.0.0.5", Category.PUBLISH, "/arm/cmd").through == ("ocu",)
    assert explained("10.0.0.7", Category.PUBLISH, "/arm/x").through == ("10.0.0.0/8",)


def test_node_rule_is_part_of_the_answer() -> None:
    explanation = explained("10.0.0.5", Category.PUBLISH, "/arm/cmd", node="/radar")
    assert explanation.decision.allowed
    assert not explanation.allowed
    assert decide(POLICY, rights_of(explanation.request)).allowed == explanation.allowed
    assert any(line.startswith("together: denied") for line in render(explanation))


def test_command_is_explained_under_its_wire_name_too() -> None:
    explanation = explained("10.0.0.1", Category.COMMAND, "system.listMethods")
    assert explanation.decision.allowed
    assert explanation.decision.rule is not None
    assert explanation.decision.rule.key == "listMethods"
    assert [lost.rule.key for lost in explanation.lost] == ["default"]


def test_text_says_decision_and_place() -> None:
    lines = list(render(explained("10.0.0.9", Category.COMMAND, "getPid")))
    assert lines[0].startswith(
        "denied: 10.0.0.9 is not among the hosts that may call getPid: only ocu (10.0.0.5)"
    )
    assert lines[1] == "  rule: [Commands] default (p.ini:11)"


def test_dependence_on_a_namespace_is_explained() -> None:
    policy = compile_policy("[Parameters]\nread /arm = 10.0.0.5\nread /leg/** = 10.0.0.5\n", file="p.ini")
    host = ipaddress.ip_address("10.0.0.5")
    lines = list(render(explain(policy, Request(host, "/ocu", Category.READ, "/arm"))))
    assert lines[0].startswith("allowed")
    assert any(
        line.startswith("  but denied if it has parameters below it: 10.0.0.5 may not read") for line in lines
    )
    lines = list(render(explain(policy, Request(host, "/ocu", Category.READ, "/leg"))))
    assert not any("namespace" in line for line in lines)


def test_explain_shows_the_limit_and_its_line() -> None:
    limits = policy("/scan = publisher guests 20 Hz 1500 kB/s, topic 100 Hz, subscriber 5 Hz")
    [publish, subscribe] = [
        list(render(explain(limits, Request(GUEST, "/lidar", category, "/scan"))))
        for category in (Category.PUBLISH, Category.SUBSCRIBE)
    ]
    line = "[Limits] /scan (p.ini:13)"
    own, all_hosts = "for all its nodes together", "for all publishers together, in equal parts"
    assert (
        f"  limit: 20 Hz, 1.5 MB/s {own}; 100 Hz {all_hosts} for hosts that want more, by {line}" in publish
    )
    assert f"  limit: 5 Hz, by {line}" in subscribe
    call = explain(limits, Request(GUEST, "/lidar", Category.COMMAND, "getPid"))
    assert call.limit == ""


def test_a_missing_approval_is_explained() -> None:
    request = Request(AGENT, "/it", Category.PUBLISH, "/cmd_vel")
    assert [*render(explain(policy_that_asks(), request))][-1] == "together: needs an approval"
