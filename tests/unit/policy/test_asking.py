from dataclasses import replace

import pytest

from appliance.policy.cases import run_cases
from appliance.policy.judgement import approvals_of
from appliance.policy.model import Category, Request, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rights import Right, decide, rights_of, rights_of_call

TEXT = """
[Groups]
operator = 10.0.0.1
agent-1 = 10.0.0.7
[Nodes]
default = operator agent-1
[Publishers]
/cmd_vel = operator, ask agent-1
[Subscribers]
default = operator
[Commands]
default = operator agent-1
[Clients]
/reset = operator ask agent-1
[Parameters]
read default = operator
write /arm/** = operator ask agent-1
write /arm/max = ask agent-1
write /arm/secret = operator
"""
AGENT, OPERATOR = address_of("10.0.0.7"), address_of("10.0.0.1")


def policy(text: str = TEXT, *approved: tuple[str, str, str]) -> Policy:
    compiled = compile_policy(text, file="site.ini")
    return replace(compiled, approved=approvals_of(approved)) if approved else compiled


def verdict(policy: Policy, category: Category, name: str, host: object = AGENT) -> tuple[str, bool]:
    decision = decide(policy, rights_of(Request(host, "/it", category, name)))  # type: ignore[arg-type]  # any host
    return decision.verdict, decision.allowed


def test_a_host_behind_ask_passes_only_while_its_approval_lasts() -> None:
    bare, live = policy(), policy(TEXT, ("10.0.0.7", "publish", "/cmd_vel"))
    for category, name in (
        (Category.PUBLISH, "/cmd_vel"),
        (Category.CALL, "/reset"),
        (Category.WRITE, "/arm/x"),
    ):
        assert verdict(bare, category, name) == ("ask", False)
        assert verdict(bare, category, name, OPERATOR) == ("allow", True)
    assert verdict(live, Category.PUBLISH, "/cmd_vel") == ("ask", True)
    assert verdict(live, Category.CALL, "/reset") == ("ask", True)
    assert verdict(live, Category.WRITE, "/arm/x") == ("ask", False)
    assert verdict(live, Category.PUBLISH, "/other") == ("deny", False)


def test_a_denial_goes_before_a_missing_approval() -> None:
    """Operators are not asked about requests that would be denied anyway, such as for a parameter below the key."""
    nameless = policy(TEXT.replace("default = operator agent-1", "default = operator", 1))
    assert verdict(nameless, Category.PUBLISH, "/cmd_vel") == ("deny", False)
    below = Right(Request(AGENT, "/it", Category.WRITE, "/arm"), namespace=True)
    assert decide(policy(TEXT, ("10.0.0.7", "write", "/arm")), [below]).verdict == "deny"
    open_below = policy(TEXT.replace("secret = operator", "secret = * "), ("10.0.0.7", "write", "/arm"))
    assert decide(open_below, [below]).allowed, "an approval of a namespace covers what asks below it"
    plain = policy(open_below.text + "write /arm = agent-1\n", ("10.0.0.7", "write", "/arm"))
    assert decide(plain, [below]).asks is not None, "it asks even while it is approved"


def test_each_right_that_asks_needs_its_own_approval() -> None:
    text = TEXT.replace("write /arm/**", "write /arm = ask agent-1\nwrite /arm/**")
    request = Request(AGENT, "/it", Category.COMMAND, "setParam")
    rights = rights_of_call(request, "setParam", "/arm/x", value=1, tree={"arm": 5})
    one, other = ("10.0.0.7", "write", "/arm/x"), ("10.0.0.7", "write", "/arm")
    for approved, missing in (((one,), "/arm"), ((other,), "/arm/x"), ((one, other), None)):
        decision = decide(policy(text, *approved), rights)
        asked = None if decision.allowed or decision.asks is None else decision.asks.resource
        assert (decision.allowed, asked) == (missing is None, missing)


def test_a_blocked_host_and_a_group_without_a_claim_are_not_asked_for() -> None:
    blocked = replace(policy(TEXT, ("10.0.0.7", "publish", "/cmd_vel")), blocks={AGENT: "blocked by ann"})
    assert verdict(blocked, Category.PUBLISH, "/cmd_vel") == ("deny", False)
    grouped = policy(f"{TEXT}[Authority]\nbase = /cmd_vel\ntake base = operator\n")
    assert verdict(grouped, Category.PUBLISH, "/cmd_vel") == ("deny", False)


def test_every_reader_of_a_policy_knows_ask() -> None:
    asked, plain = policy(), policy(TEXT.replace("ask agent-1", "agent-1"))
    cases = "cases: [{host: 10.0.0.7, node: /it, ask: [publish /cmd_vel], deny: [call /other]}]"
    assert [case.passed for case in run_cases(asked, cases, "cases")] == [True, True]
    assert [case.passed for case in run_cases(plain, cases, "cases")] == [True, False]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[Groups]\nask = 10.0.0.1", "reserved"),
        ("[Subscribers]\n/x = ask 10.0.0.1", "is for [Publishers]"),
        ("[Parameters]\nread /x = ask 10.0.0.1", "is for [Publishers]"),
        ("[Publishers]\n/x = ask", "name the hosts"),
        ("[Publishers]\n/x = ask 10.0.0.1 ask 10.0.0.2", "already in this line"),
        ("[Limits]\n/x = publisher 1/s ask", ""),
    ],
)
def test_ask_elsewhere_is_an_error(text: str, fault: str) -> None:
    with pytest.raises(PolicyError) as caught:
        compile_policy(text, file="site.ini")
    assert any(fault in finding.text for finding in caught.value.findings)
