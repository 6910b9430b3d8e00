import ipaddress

from appliance.policy.diff import diff
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy

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
