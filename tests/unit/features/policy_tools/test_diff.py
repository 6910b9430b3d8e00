import ipaddress
from typing import Any

import pytest

from appliance.features.policy_tools.diff import diff
from appliance.master.calls.call import RosCall
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import Right
from tests.unit.features.policy_tools.test_rights import ROWS
from tests.unit.policy.test_asking import AGENT
from tests.unit.policy.test_asking import TEXT as ASKS
from tests.unit.policy.test_asking import policy as policy_that_asks
from tests.unit.policy.test_rate_limits import GUEST
from tests.unit.policy.test_rate_limits import policy as limited

OLD = "[Nodes]\ndefault = *\n[Publishers]\ndefault = 10.0.0.1\n/cmd = 10.0.0.5\n"


def request(host: str, resource: str, node: str = "/n") -> Request:
    return Request(ipaddress.ip_address(host), node, Category.PUBLISH, resource)


def test_each_different_decision_is_listed_once_with_its_count() -> None:
    old = compile_policy(OLD, file="old.ini")
    new = compile_policy(OLD.replace("/cmd = 10.0.0.5", "/cmd = 10.0.0.6"), file="new.ini")
    seen = [request("10.0.0.5", "/cmd"), request("10.0.0.6", "/cmd"), request("10.0.0.1", "/x")]
    found = diff(old, new, [*seen, seen[0]])
    assert [(str(d.request.host), d.granted, d.count) for d in found] == [
        ("10.0.0.5", False, 2),
        ("10.0.0.6", True, 1),
    ]
    assert "new.ini:5" in found[0].new.reason


def test_lost_node_name_is_a_difference() -> None:
    old = compile_policy(OLD, file="old.ini")
    new = compile_policy(OLD.replace("default = *", "default = *\n/n = 10.0.0.9"), file="new.ini")
    found = diff(old, new, [request("10.0.0.1", "/x"), request("10.0.0.1", "/x", node="/m")])
    assert [d.request.caller_id for d in found] == ["/n"]


def test_audit_only_is_between_allowed_and_denied() -> None:
    old = compile_policy(OLD + "[Options]\naudit-only = Publishers\n", file="old.ini")
    new = compile_policy(OLD, file="new.ini")
    found = diff(old, new, [request("10.0.0.9", "/cmd"), request("10.0.0.1", "/x")])
    assert [(d.old.would_deny, d.new.allowed) for d in found] == [(True, False)]


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("", "/scan = publisher 5 Hz", "limited"),
        ("/scan = publisher 5 Hz", "/scan = publisher 9 Hz", "limited less"),
    ],
)
def test_diff_shows_changed_limits(old: str, new: str, word: str) -> None:
    request = Request(GUEST, "/lidar", Category.PUBLISH, "/scan")
    [difference] = diff(limited(old), limited(new), [request, request])
    assert (difference.word, difference.count) == (word, 2)
    assert "5 Hz in [Limits]" in difference.old.reason + difference.new.reason
    assert diff(limited(new), limited(new), [request]) == []


def test_a_right_that_then_needs_an_approval_is_a_difference() -> None:
    asks, plain = policy_that_asks(), policy_that_asks(ASKS.replace("ask agent-1", "agent-1"))
    wanted = Request(AGENT, "/it", Category.PUBLISH, "/cmd_vel")
    assert [one.word for one in diff(plain, asks, [wanted])] == ["needs approval"]
    assert not diff(asks, asks, [wanted])


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.row.touches is not None], ids=lambda one: one.name
)
def test_a_recorded_right_to_a_parameter_is_compared_alone(row: RosCall[Any]) -> None:
    """`hasParam` needs no right to `getParam`."""
    assert row.row.touches is not None
    right = Right(Request(GUEST, "/it", row.row.touches, "/arm/max"))
    old = compile_policy("[Nodes]\n[Commands]\ndefault = *\n", file="old.ini")
    new = compile_policy("[Nodes]\n[Commands]\n[Parameters]\nread /x = *\n", file="new.ini")
    fewer = compile_policy("[Nodes]\n[Commands]\n", file="fewer.ini")
    assert [(one.request, one.word, one.count) for one in diff(old, new, [right, right])] == [
        (right.request, "denied", 2)
    ]
    assert diff(old, fewer, [right]) == []
