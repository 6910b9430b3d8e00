"""The lint: what a policy allows and an operator most likely did not mean."""

import ipaddress

import pytest

from appliance.policy.policy_compiler import compile_policy

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
"""


def warnings_of(text: str, robot: str = "") -> list[str]:
    """`line:column: text` of every warning."""
    given = [ipaddress.ip_address(robot)] if robot else []
    return [
        f"{w.line}:{w.column}: {w.text}" for w in compile_policy(text, file="p.ini", robot=given).warnings
    ]


def test_right_policy_has_no_warning() -> None:
    """The lint is silent on a policy that means what it says."""
    assert warnings_of(RIGHT) == []


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("op = 10.0.0.5", "op = 10.0.0.5\nidle = ::1", '3:1: the group "idle" is used nowhere'),
        (
            "/ocu = op",
            "/ocu = 10.0.0.1",
            "7:1: 10.0.0.5 may use no node name ([Nodes]), so what default grants",
        ),
        (
            "default = op\n[C",
            "default = op\n/** = op\n[C",
            "9:1: never decides: /** at line 10 matches every name",
        ),
        (
            "[Commands]\ndefault = op 10.0.0.1",
            "[Commands]\ngetPid = op",
            "10:1: getParam is granted to nobody",
        ),
        ("/ocu = op", "/ocu = op op", '5:11: "op" is said twice'),
        ("/ocu = op", "/ocu = op host:x", '5:11: no host "x" is enrolled: host:x matches nobody'),
        ("[Subscribers]\ndefault = op\n", "", "1:1: there is no [Subscribers] section"),
        (
            "[Groups]",
            "[Options]\naudit-only = Nodes publishers\n[Groups]",
            "2:1: audit-only: this policy refuses nothing by [Nodes], [Publishers], it only records",
        ),
        (
            "[Groups]",
            "[Options]\naudit-only = all\n[Groups]",
            "2:1: audit-only: this policy refuses nothing, it only records",
        ),
    ],
)
def test_doubtful_policy_is_warned_about_with_its_place(old: str, new: str, expected: str) -> None:
    """Each kind of doubt is a warning with file, line and column, and the policy loads."""
    assert old in RIGHT
    assert any(warning.startswith(expected) for warning in warnings_of(RIGHT.replace(old, new)))


def test_host_that_lacks_a_node_name_is_named_once() -> None:
    """A host that many rules let publish but [Nodes] knows not is one warning that counts the rules."""
    text = RIGHT.replace("/ocu = op\n", "").replace("[Subscribers]", "/a = op\n/b = op\n[Subscribers]")
    found = [warning for warning in warnings_of(text) if "10.0.0.5" in warning]
    assert len(found) == 1
    assert "(4 rules)" in found[0]


def test_network_that_overlaps_a_node_right_is_not_dead() -> None:
    """A rule for a network counts as alive when one address of it may be a node, and the other way round."""
    assert warnings_of(RIGHT.replace("default = op\n", "default = 10.0.0.0/24\n")) == []
    assert warnings_of(RIGHT.replace("/ocu = op", "/ocu = 10.0.0.0/8")) == []


def test_loopback_is_warned_about_where_the_robot_is_elsewhere() -> None:
    """127.0.0.1 where the robot is elsewhere, or not known, is the appliance itself; the warning names the robot."""
    text = RIGHT.replace("10.0.0.1", "127.0.0.1")
    (unknown,) = warnings_of(text)
    assert "127.0.0.1 is the appliance itself (unless isolation is none): write robot" in unknown
    assert warnings_of(text, robot="127.0.0.1") == []
    found = warnings_of(text, robot="172.17.0.1")
    assert len(found) == 1
    assert "127.0.0.1 is the appliance itself here; the robot is 172.17.0.1" in found[0]
