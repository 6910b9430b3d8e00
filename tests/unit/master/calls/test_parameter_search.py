"""searchParam finds readable keys as the ROS master does, and reveals no unreadable keys."""

import ipaddress
from typing import Any, cast

import pytest

from appliance.master.caller import Answer, Caller
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.parameter_rights import ParameterRights
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.server import Peer
from roswire.parameter_tree import standing_at
from tests.support import autojump
from tests.support.parameters import mirror

HOST = "10.0.0.5"
RULES = "[Parameters]\nread default = 10.0.0.5\nread /secret/** = 10.0.0.9\nread /arm/key = 10.0.0.9\n"


class Site:
    """A ROS master with these parameters, and the records: (name, decision)."""

    def __init__(self, tree: Any, rules: str = RULES) -> None:
        policy = compile_policy(rules, file="test.ini")
        self.parameters = mirror(tree)
        rights = ParameterRights(lambda: policy, cast(Any, self))
        nothing = cast(Any, None)  # a search changes nothing
        self.calls = ParameterCalls(cast(Any, self), self.parameters, nothing, nothing, rights, 0)
        self.asked: list[str] = []
        self.records: list[tuple[str, Decision]] = []

    def decided(self, _caller: Any, method: str, _category: str, resource: str, decision: Decision) -> str:
        """Act as `AuditTrail`."""
        assert method == "searchParam"
        self.records.append((resource, decision))
        return f"id{len(self.records)}"

    async def call(self, _method: str, caller_id: Any, key: Any) -> Answer:
        """Search as the ROS master does."""
        self.asked.append(key)
        first = key.strip("/").split("/")[0]
        namespace = [] if key.startswith("/") else caller_id.strip("/").split("/")
        for depth in range(len(namespace), -1, -1):
            base = "".join(f"/{part}" for part in namespace[:depth])
            if standing_at(self.parameters.tree, f"{base}/{first}")[0] is not None:
                name = f"{base}/{key.strip('/')}"
                return [1, f"Found [{name}]", name]
        return [-1, f"Cannot find parameter [{key}] in an upwards search", ""]

    def search(self, caller_id: str, key: str, *, own: bool = False) -> Answer:
        peer = Peer(ipaddress.ip_address(HOST), HOST, "10.0.0.1")
        caller = Caller(peer, caller_id, 0, own=own)
        return autojump.run(self.calls.search_param(caller, key))


@pytest.mark.parametrize(
    ("caller_id", "key"),
    [
        ("/secret/inside", "key"),
        ("/me", "/secret/key"),
        ("/me", "//secret//key/"),
        ("/secret/a/b", "key/below"),
        ("/secret", "key"),
    ],
)
def test_the_answer_does_not_reveal_whether_a_key_exists(caller_id: str, key: str) -> None:
    """An unreadable key gets the same answer whether or not it exists: the rule, and the id of the record."""
    answers = [Site(tree).search(caller_id, key) for tree in ({"secret": {"key": 1}, "open": 1}, {"open": 1})]
    assert answers[0] == answers[1]
    assert answers[0][0] != 1
    assert "[Parameters] read /secret/**" in str(answers[0][1])
    assert str(answers[0][1]).endswith("[id1]")


def test_a_denial_is_recorded_with_its_name() -> None:
    """A global key is decided before the search; an upward search is recorded with the first key it may not reveal."""
    site = Site({"secret": {"key": 1}})
    site.search("/me", "/secret/key")
    assert not site.asked
    site.search("/secret/inside", "key")
    assert [(name, decision.allowed) for name, decision in site.records] == [
        ("/secret/key", False),
        ("/secret/inside/key", False),
    ]


def test_a_search_goes_on_above_a_hidden_name() -> None:
    """A search treats an unreadable key as if it did not exist."""
    for tree in ({"arm": {"key": 1}, "key": 2}, {"arm": {}, "key": 2}):
        site = Site(tree)
        assert site.search("/arm/node", "key")[::2] == [1, "/key"]
        assert site.search("/arm/node", "key/sub")[::2] == [1, "/arm/key/sub" if tree["arm"] else "/key/sub"]
        assert not site.records


def test_readable_keys_are_found_as_in_plain_ros() -> None:
    """Where the policy hides nothing, the answer equals the ROS master's, even if nothing is found."""
    site = Site({"arm": {"gain": 1}, "top": 2})
    assert site.search("/arm/node", "gain") == [1, "Found [/arm/gain]", "/arm/gain"]
    assert site.search("/arm/node", "/top") == [1, "Found [/top]", "/top"]
    assert site.search("/arm/node", "none") == [-1, "Cannot find parameter [none] in an upwards search", ""]
    assert site.search("/secret/x", "key", own=True)[0] == -1
    assert not site.records


def test_audit_only_records_the_names_that_pass() -> None:
    """In audit-only mode the name is found, and the record says that it would have been denied."""
    site = Site({"secret": {"key": 1}}, RULES + "[Options]\naudit-only = parameters\n")
    assert site.search("/secret/inside", "key")[2] == "/secret/key"
    assert [(name, decision.would_deny) for name, decision in site.records] == [("/secret/key", True)]
