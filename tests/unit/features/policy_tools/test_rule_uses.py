from ipaddress import ip_address

import pytest

from appliance.features.policy_tools.learn import Observation
from appliance.features.policy_tools.rule_uses import RuleUse, RuleUses
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy

TEXT = """\
[Groups]
joystick = 10.0.0.5
[Nodes]
default = *
[Publishers]
/cmd_vel = joystick robot
/scan    = robot
[Subscribers]
/scan = joystick
[Commands]
getParam = joystick
shutdown =
[Parameters]
read /arm/** = joystick
"""
JOYSTICK, ROBOT = ip_address("10.0.0.5"), ip_address("192.0.2.1")
POLICY = compile_policy(TEXT, file="p.ini", robot=[ROBOT])


def rows(uses: RuleUses, unnamed: str = "", *, removed: bool = False) -> dict[str, RuleUse]:
    found = uses.rules({unnamed: 40} if unnamed else {}, removed=removed)
    return {f"{row.rule.section} {row.rule.key}": row for row in found}


def used(*observations: tuple[str, Category, str, str, str]) -> RuleUses:
    uses = RuleUses(POLICY)
    for host, category, name, call, key in observations:
        uses.add(Observation(Request(ip_address(host), "/it", category, name), call, key, count=3))
    return uses


def test_a_request_uses_each_rule_that_it_needed() -> None:
    uses = rows(used(("10.0.0.5", Category.COMMAND, "getParam", "getParam", "/arm/gain")))
    assert {name for name, row in uses.items() if row.used} == {
        "Commands getParam",
        "Parameters read /arm/**",
    }
    assert uses["Commands getParam"].state == "used"


def test_each_host_of_a_line_has_uses_of_its_own() -> None:
    uses = rows(used(("10.0.0.5", Category.PUBLISH, "/cmd_vel", "registerPublisher", "")))
    assert (uses["Publishers /cmd_vel"].state, uses["Publishers /cmd_vel"].unused) == ("unused", ("robot",))
    assert uses["Nodes default"].state == "used"


def test_a_denied_request_uses_no_rule_and_a_line_without_hosts_grants_nothing() -> None:
    uses = rows(used(("10.0.0.5", Category.PUBLISH, "/scan", "registerPublisher", "")))
    assert uses["Publishers /scan"].state == "unused"
    assert "Commands shutdown" not in uses


def test_a_registration_that_lives_is_a_use_however_old() -> None:
    uses = used()
    uses.add_live([LiveRight(ROBOT, "/laser", "registerPublisher", "/scan")])
    assert rows(uses)["Publishers /scan"].state == "used"


@pytest.mark.parametrize("name", ["Publishers /cmd_vel", "Publishers /scan", "Parameters read /arm/**"])
def test_nothing_is_unused_where_records_are_removed(name: str) -> None:
    assert rows(used(), removed=True)[name].state == "unknown"
    assert rows(used(), "*")[name].state == "unknown"


def test_a_host_whose_requests_are_only_counted_is_unknown_and_others_are_not() -> None:
    uses = rows(used(), "10.0.0.5")
    row = uses["Publishers /cmd_vel"]
    assert (row.unknown, row.unused) == (("joystick",), ("robot",))
    assert uses["Publishers /scan"].state == "unused"
    assert uses["Subscribers /scan"].state == "unknown"


def test_a_right_that_has_ended_is_named_used_or_not() -> None:
    """Its use counts: the request was decided in its time."""
    text = "[Nodes]\ndefault = *\n[Publishers]\n/a = 10.0.0.5 until 2026-12-05, 10.0.0.6 until 2026-12-05\n"
    uses = RuleUses(compile_policy(text, file="p.ini", now=1_797_040_000.0))
    uses.add(Observation(Request(JOYSTICK, "/it", Category.PUBLISH, "/a"), "registerPublisher", count=3))
    row = rows(uses)["Publishers /a"]
    assert (row.used, row.unused) == (3, ("10.0.0.6 until 2026-12-05",))
    assert row.ended == ("10.0.0.5 until 2026-12-05", "10.0.0.6 until 2026-12-05")
