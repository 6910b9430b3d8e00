import ipaddress
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from appliance.features import policy_tools
from appliance.features.policy_tools.grant import DecidedRequest, UngrantableError, asked, grant
from appliance.features.policy_tools.stock_tools import stock_tool
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import Right, decide, decide_right, rights_of, rights_of_call
from appliance.policy.sections import DECIDERS
from roswire.parameter_tree import Tree
from roswire.xmlrpc import Value
from tests.unit.policy.test_asking import AGENT
from tests.unit.policy.test_asking import TEXT as ASKS

POLICIES = sorted((Path(__file__).parents[4] / "policies").glob("*.ini"))
ROBOT = ipaddress.ip_network("10.84.0.2/32")
HOST, OTHER = ipaddress.ip_address("10.0.0.9"), ipaddress.ip_address("10.0.0.10")
KNOWN = PolicyContext({"laptop": ipaddress.ip_address("10.0.0.77")}, [ROBOT])
NAMES = ("/cmd_vel", "/arm", "/arm/max", "/landshark_control/base_velocity", "/a/b/c")
CALLS = ("lookupService", "getParam", "setParam", "shutdown", "getSystemState", "getRVState")


def request(category: Category, resource: str, host: object = HOST) -> Request:
    return Request(host, "/it", category, resource)  # type: ignore[arg-type]  # an address


def everything(host: object) -> list[Request]:
    named = [category for category in Category if category is not Category.COMMAND]
    return [request(category, name, host) for category, name in product(named, NAMES)] + [
        request(Category.COMMAND, call, host) for call in CALLS
    ]


def compiled(text: str) -> Policy:
    return compile_policy(text, file="p.ini", hosts=KNOWN.hosts, robot=KNOWN.robot)


@pytest.mark.parametrize("file", POLICIES, ids=lambda file: str(file.stem))
@pytest.mark.parametrize("wanted", everything(HOST), ids=lambda one: f"{one.category} {one.resource}")
def test_it_grants_that_and_nothing_else(file: Path, wanted: Request) -> None:
    text = file.read_text(encoding="utf-8")
    found = grant(text, "p.ini", KNOWN, DecidedRequest(wanted, rights_of(wanted)))
    before, after = compiled(text), compiled(found.text)
    assert decide(after, rights_of(wanted)).allowed
    needed = {(right.request.category, right.request.resource) for right in rights_of(wanted)}
    for host in (HOST, OTHER, ipaddress.ip_address("10.84.0.2"), ipaddress.ip_address("127.0.0.1")):
        for one in everything(host):
            was, now = before.decide(one).allowed, after.decide(one).allowed
            gained = host == HOST and (one.category, one.resource) in needed
            assert now is (True if gained else was), (one, found.added)
    kept = [line for line in found.text.splitlines() if line not in found.added]
    assert len(text.splitlines()) - len(kept) <= len(found.added)
    assert bool(found.added) is not decide(before, rights_of(wanted)).allowed


def changed(text: str, category: str, resource: str, host: str = str(HOST), **detail: object) -> list[str]:
    found = grant(text, "p.ini", KNOWN, asked(host, "/it", category, resource, detail))
    return [line[1:] for line in found.diff(text, "p.ini") if line[:1] == "+" and line[:3] != "+++"]


BASE = (
    "[Nodes]\ndefault = *\n[Publishers]\n/x = 10.0.0.1, 10.0.0.2  # the two\n/y* = 10.0.0.1\n[Subscribers]\n"
)


def test_the_host_is_added_to_the_deciding_key() -> None:
    assert changed(BASE, "publish", "/x") == ["/x = 10.0.0.1, 10.0.0.2, 10.0.0.9  # the two"]
    padded = BASE.replace("/x =", "/x      =   ")
    found = grant(padded, "p.ini", KNOWN, asked(str(HOST), "/it", "publish", "/x", {}))
    assert found.added == ("/x = 10.0.0.1, 10.0.0.2, 10.0.0.9",)


def test_a_new_key_keeps_the_hosts_of_the_deciding_rule() -> None:
    assert changed(BASE, "publish", "/yes") == ["/yes = 10.0.0.1 10.0.0.9"]
    assert changed(BASE, "subscribe", "/z") == ["/z = 10.0.0.9"]
    assert changed("[Nodes]\ndefault = *\n", "publish", "/z") == ["", "[Publishers]", "/z = 10.0.0.9"]


def test_a_host_is_named_by_its_group_or_certificate() -> None:
    grouped = "[Groups]\nocu = 10.0.0.9\nall = 10.0.0.9 10.0.0.1\n" + BASE
    assert changed(grouped, "subscribe", "/z") == ["/z = ocu"]
    assert changed(BASE, "subscribe", "/z", "10.0.0.77") == ["/z = host:laptop"]
    assert changed(BASE, "subscribe", "/z", "10.84.0.2") == ["/z = robot"]


@pytest.mark.parametrize("category", Category)
@pytest.mark.parametrize("case", [str.lower, str.upper])
def test_names_of_sections_ignore_case(category: Category, case: Callable[[str], str]) -> None:
    """Each section is found: that of the host's group, of the rules and of the options."""
    one = request(category, "setParam" if category is Category.COMMAND else "/x")
    asked_for = DecidedRequest(one, rights_of(one), takeover=True)
    text = "[Groups]\nocu = 10.0.0.9\n[Options]\ntakeover = same-host\n"
    text += "".join(f"[{decider.name}]\n" for decider in DECIDERS)
    other = re.sub(r"\[\w+\]", lambda name: case(name[0]), text)
    found, changed = (grant(some, "p.ini", KNOWN, asked_for) for some in (text, other))
    assert changed.added == found.added and changed.text.lower() == found.text.lower()
    compiled(changed.text)


def test_an_address_of_the_machine_is_granted_as_the_robot_unless_the_policy_names_it() -> None:
    """A rule with the address would take it out of the group, with all its other rights."""
    own = replace(KNOWN, own=[HOST])
    wanted = DecidedRequest(request(Category.SUBSCRIBE, "/z"), [Right(request(Category.SUBSCRIBE, "/z"))])
    text = "[Nodes]\ndefault = robot\n[Subscribers]\n/a = robot\n"
    found = grant(text, "p.ini", own, wanted)
    assert found.added == ("/z = robot",)
    assert own.compile(found.text, "p.ini").decide(request(Category.SUBSCRIBE, "/a")).allowed
    named = grant(text + "/b = 10.0.0.9\n", "p.ini", own, wanted)
    assert "/z = 10.0.0.9" in named.added


def test_no_tool_compiles_a_policy_with_a_part_of_what_is_known_beside_it() -> None:
    """`PolicyContext.compile` takes all: hosts, the robot, and the other addresses of its machine."""
    tools = Path(policy_tools.__file__).parent
    assert [file.name for file in tools.glob("*.py") if "hosts=known.hosts" in file.read_text("utf-8")] == []


def test_a_call_about_a_parameter_needs_the_parameter_too() -> None:
    text = (
        "[Nodes]\ndefault=*\n[Commands]\nsetParam = 10.0.0.1\n"
        "[Parameters]\nwrite /arm/max = 10.0.0.1\nwrite default = 10.0.0.1\n"
    )
    added = changed(text, "command", "setParam", call="setParam", key="/arm")
    assert added == [
        "setParam = 10.0.0.1 10.0.0.9",
        "write /arm/max = 10.0.0.1 10.0.0.9",
        "write /arm = 10.0.0.1 10.0.0.9",
    ]


FREE = "[Nodes]\ndefault = *\n[Commands]\ndefault = *\n[Parameters]\n"
PARAMETERS = [
    FREE + rules.replace(", ", "\n")
    for rules in (
        "read /arm = 10.0.0.9, write /arm = 10.0.0.9, read default = 10.0.0.1, write default = 10.0.0.1",
        "read /arm/max = 10.0.0.1, write /arm/max = 10.0.0.1, read default = *, write default = *",
        "read /*/max = 10.0.0.1, write /*/max = 10.0.0.1, read default = *, write default = *",
        "read /*/max/** = 10.0.0.1, write /l*/** = 10.0.0.1, write /a* = 10.0.0.1, read default = *, write default = *",
        "read /** = 10.0.0.1, write /** = 10.0.0.1, write /arm* = 10.0.0.9, read /leg/** = 10.0.0.9",
    )
]


@pytest.mark.parametrize("text", PARAMETERS)
@pytest.mark.parametrize(
    ("call", "key", "value", "tree"),
    [
        ("getParam", "/arm", None, {"arm": {"max": 3}}),
        ("setParam", "/arm", {"max": 3}, {}),
        ("setParam", "/arm", 1, {"arm": {"max": 3}}),
        ("setParam", "/leg/max/x", 1, {"leg": {"max": 3}}),
        ("deleteParam", "/leg", None, {"leg": {"max": 3}}),
        ("getParam", "/", None, {"leg": {"max": 3}}),
        ("hasParam", "/", None, {"leg": {"max": 3}}),
    ],
)
def test_a_parameter_that_only_the_record_describes_is_granted(
    text: str, call: str, key: str, value: Value, tree: Tree
) -> None:
    def answer(policy: Policy, host: object, key: str = key, tree: Tree = tree) -> Decision:
        command = request(Category.COMMAND, call, host)
        return decide(policy, rights_of_call(command, call, key, value=value, tree=tree))

    before = compiled(text)
    for _ in range(3):
        decision = answer(compiled(text), HOST)
        if decision.allowed:
            break
        detail = {"call": call, "key": key, "needs": decision.needs}
        found = grant(text, "p.ini", KNOWN, asked(str(HOST), "/it", "command", call, detail))
        assert found.added, decision
        text = found.text
    assert decision.allowed
    trees: list[Tree] = [{}, {"arm": {"max": 3}}, {"leg": {"max": {"x": 3}}}]
    keys = ["/", "/arm", "/arm/max", "/arm/min", "/leg", "/leg/max", "/leg/max/x", "/leg/y", "/foot/max"]
    for other, there, name in product((OTHER, ipaddress.ip_address("10.0.0.1")), trees, keys):
        was, now = (answer(policy, other, name, there).allowed for policy in (before, compiled(text)))
        assert now is was, (other, name, there, text)


def test_a_text_keeps_its_line_endings() -> None:
    for resource in ("/x", "/yes", "/new"):
        found = grant(
            BASE.replace("\n", "\r\n"), "p.ini", KNOWN, asked(str(HOST), "/it", "publish", resource, {})
        )
        assert found.text.count("\n") == found.text.count("\r\n"), resource
    [*_, section, line, _end] = grant(
        "[Nodes]\r\ndefault = *\r\n", "p.ini", KNOWN, asked(str(HOST), "/it", "publish", "/z", {})
    ).text.split("\n")
    assert (section, line) == ("[Publishers]\r", "/z = 10.0.0.9\r")


@pytest.mark.parametrize(
    ("host", "category", "resource", "why"),
    [
        (str(HOST), "command", "bogus", "not a call that the appliance knows"),
        ("", "publish", "/x", "not a record of a decision"),
        (str(HOST), "monitor", "/x", "not a record of a decision"),
        (str(HOST), "publish", "no name", "is not a resolved ROS name"),
    ],
)
def test_a_request_that_no_policy_can_grant(host: str, category: str, resource: str, why: str) -> None:
    with pytest.raises(UngrantableError, match=why):
        changed(BASE, category, resource, host)


def test_a_right_gives_no_claim_to_a_command_group() -> None:
    text = f"{BASE}[Authority]\nbase = /x\ntake base = 10.0.0.7\n"
    with pytest.raises(
        UngrantableError, match=r"no line of \[Authority\] base lets it take, override or ask$"
    ):
        changed(text, "publish", "/x", str(HOST))


def test_failing_cases_are_reported() -> None:
    known = PolicyContext(
        cases_file="p.tests.yaml", cases="cases:\n  - {host: 10.0.0.9, node: /it, deny: [subscribe /z]}\n"
    )
    found = grant(BASE, "p.ini", known, asked(str(HOST), "/it", "subscribe", "/z", {}))
    [finding] = found.findings("p.ini", known)
    assert finding.startswith("p.tests.yaml:2:")
    assert "expected deny" in finding


TOOLS = (
    "/rostopic", "/rosnode", "/rosservice", "/rosparam-47", "/record_1700000000000000000",
    "/play_1700000000000000000",
)  # fmt: skip


@pytest.mark.parametrize("file", POLICIES, ids=lambda file: str(file.stem))
@pytest.mark.parametrize("caller", TOOLS)
def test_a_stock_tool_gets_all_that_it_needs(file: Path, caller: str) -> None:
    tool = stock_tool(caller)
    assert tool is not None
    text, denied = file.read_text(encoding="utf-8"), Request(HOST, caller, Category.SUBSCRIBE, "/speed")
    found = grant(text, "p.ini", KNOWN, DecidedRequest(denied, [Right(denied)]).with_tool(tool))
    before, after = compiled(text), compiled(found.text)
    for right in tool.rights(HOST):
        assert decide_right(after, right).allowed
        other = Right(replace(right.request, host=OTHER))
        assert decide_right(after, other).allowed is decide_right(before, other).allowed
    again = Request(HOST, f"/{tool.name}_99_1800000000000", Category.SUBSCRIBE, "/speed")
    assert decide(after, rights_of(again)).allowed is tool.node
    for harmful in ("shutdown", "setParam", "deleteParam", "monitorControl", "getRVState"):
        call = request(Category.COMMAND, harmful)
        assert after.decide(call).allowed is before.decide(call).allowed


@pytest.mark.parametrize("name", ["/record", "/cmd_1_1700000000000", "/arm"])
def test_another_name_is_granted_alone(name: str) -> None:
    """A host that invents a numbered name gets no pattern such as /cmd_*, which would also match /cmd_vel."""
    assert stock_tool(name) is None
    wanted = Request(HOST, name, Category.NODE, name)
    found = grant("[Nodes]\n/x = 10.0.0.1\n", "p.ini", KNOWN, DecidedRequest(wanted, rights_of(wanted)))
    assert found.added == (f"{name} = 10.0.0.9",)


def test_a_grant_to_a_host_behind_ask_needs_no_approval() -> None:
    wanted = Request(AGENT, "/it", Category.PUBLISH, "/cmd_vel")
    granted = grant(ASKS, "site.ini", PolicyContext(), DecidedRequest(wanted, rights_of(wanted)))
    assert "/cmd_vel = operator agent-1, ask agent-1" in granted.text


NOW = replace(KNOWN, now=1_796_040_000.0)  # 2026-11-30 12:00 in UTC


@pytest.mark.parametrize(
    ("before", "until", "after"),
    [
        (
            "/x = 10.0.0.1 until 2027-01-01, 10.0.0.2  # two",
            "7d",
            "/x = 10.0.0.1 until 2027-01-01, 10.0.0.2, 10.0.0.9 until 2026-12-07T12:00  # two",
        ),
        (
            "/x = 10.0.0.9 until 2026-11-20, 10.0.0.2  # two",
            "2026-12-05",
            "/x = 10.0.0.9 until 2026-12-05, 10.0.0.2  # two",
        ),
        ("/x = 10.0.0.9 until 2026-11-20, 10.0.0.2", "", "/x = 10.0.0.9, 10.0.0.2"),
        (
            "/x* = 10.0.0.1 until 2027-01-01, 10.0.0.2 until 2027-01-01, ask 10.0.0.3",
            "2h",
            "/x = 10.0.0.1 until 2027-01-01 10.0.0.2 until 2027-01-01 10.0.0.9 until 2026-11-30T14:00 ask 10.0.0.3",
        ),
    ],
)
def test_a_right_with_a_time_is_written_and_the_times_of_others_are_kept(
    before: str, until: str, after: str
) -> None:
    text = f"[Nodes]\ndefault = *\n[Publishers]\n{before}\n[Subscribers]\n"
    found = grant(text, "p.ini", NOW, asked(str(HOST), "/it", "publish", "/x", {}), until)
    assert after in found.text.splitlines()
    assert decide_right(NOW.compile(found.text, "p.ini"), Right(request(Category.PUBLISH, "/x"))).allowed


@pytest.mark.parametrize(
    ("known", "until", "expected"),
    [
        (NOW, "2026-11-01", "has passed"),
        (NOW, "soon", "or a time such as 7d"),
        (KNOWN, "7d", "clock is not set"),
    ],
)
def test_a_right_gets_no_end_that_is_none(known: PolicyContext, until: str, expected: str) -> None:
    with pytest.raises(UngrantableError, match=expected):
        grant(BASE, "p.ini", known, asked(str(HOST), "/it", "publish", "/x", {}), until)
