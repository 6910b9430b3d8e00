import ipaddress
import re

import pytest

from appliance.policy.model import Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.sections import DECIDERS, Decider
from tests.unit.policy.mistakes import mistakes

RIGHT = """[Groups]
op = 10.0.0.5
[Nodes]
default = 10.0.0.1
/ocu = op
[Publishers]
default = op 10.0.0.1
[Subscribers]
default = op
[Commands]
default = op 10.0.0.1
[Services]
default = op
[Clients]
default = op
[Parameters]
read default = op
write default = op
"""


def warnings_of(text: str, robot: str = "") -> list[str]:
    given = [ipaddress.ip_address(robot)] if robot else []
    return [
        f"{w.line}:{w.column}: {w.text}" for w in compile_policy(text, file="p.ini", robot=given).warnings
    ]


def test_a_correct_policy_has_no_warning() -> None:
    assert warnings_of(RIGHT) == []


@pytest.mark.parametrize("decider", DECIDERS, ids=lambda one: one.name)
def test_a_missing_section_is_a_warning_that_names_its_effect(decider: Decider) -> None:
    """The effect is the one that the policy has for a host that no rule names."""
    text = re.sub(rf"\[{decider.name}\]\n(?:[^\[].*\n)*", "", RIGHT)
    assert text != RIGHT
    (warning,) = [one for one in warnings_of(text) if "there is no" in one]
    policy, host = compile_policy(text, file="p.ini"), ipaddress.IPv4Address("10.9.9.9")
    for category in decider.categories:
        allowed = policy.decide(Request(host, "", category, "/x")).allowed
        assert (
            f"[{decider.name}] section, so its requests are {'allowed' if allowed else 'denied'}" in warning
        )
        if allowed and len(decider.categories) > 1:
            assert f"{category} default = HOSTS" in warning
    if decider.extension:
        added = "".join(f"{key} = op\n" for key in re.findall(r"((?:read |write )?default) = HOSTS", warning))
        assert warnings_of(f"{text}[{decider.name}]\n{added}") == [], "the proposed keys are valid and enough"


@pytest.mark.parametrize(("old", "new", "expected"), mistakes("doubtful"))
def test_doubtful_policy_is_warned_about_with_its_place(old: str, new: str, expected: str) -> None:
    assert old in RIGHT
    assert any(warning.startswith(expected) for warning in warnings_of(RIGHT.replace(old, new)))


def test_host_that_lacks_a_node_name_is_named_once() -> None:
    text = RIGHT.replace("/ocu = op\n", "").replace("[Subscribers]", "/a = op\n/b = op\n[Subscribers]")
    warnings = [warning for warning in warnings_of(text) if "10.0.0.5" in warning]
    assert len(warnings) == 1
    assert "(5 rules)" in warnings[0]


def test_network_that_overlaps_a_node_right_is_not_dead() -> None:
    assert warnings_of(RIGHT.replace("default = op\n", "default = 10.0.0.0/24\n")) == []
    assert warnings_of(RIGHT.replace("/ocu = op", "/ocu = 10.0.0.0/8")) == []


def test_loopback_is_warned_about_where_the_robot_is_elsewhere() -> None:
    text = RIGHT.replace("10.0.0.1", "127.0.0.1")
    (unknown,) = warnings_of(text)
    assert "127.0.0.1 is the appliance itself (unless isolation is none): write robot" in unknown
    assert warnings_of(text, robot="127.0.0.1") == []
    warnings = warnings_of(text, robot="172.17.0.1")
    assert len(warnings) == 1
    assert "127.0.0.1 is the appliance itself here; the robot is 172.17.0.1" in warnings[0]
