import ipaddress

import pytest

from appliance.policy.live_rights import LiveRight, endings, live_by, may_keep
from appliance.policy.policy_compiler import compile_policy
from roswire.parameter_tree import Tree

HOST = ipaddress.ip_address("10.0.0.5")
POLICY = compile_policy(
    "[Nodes]\ndefault = *\n[Subscribers]\n/plain = *\n[Commands]\ndefault = *\n"
    "[Parameters]\nread /x = 10.0.0.5\nread default =\n",
    file="policy",
)


@pytest.mark.parametrize(("tree", "kept"), [({}, True), ({"x": 1}, True), ({"x": {"y": 1}}, False)])
def test_a_parameter_that_holds_others_needs_the_right_on_them(tree: Tree, kept: bool) -> None:
    live = live_by("subscribeParam", HOST, "/n", "/x", tree)
    assert may_keep(POLICY, LiveRight.of(live.fields())).allowed == kept


def test_a_thing_that_ends_is_named_once() -> None:
    calls = ("registerSubscriber", "requestTopic")
    live = [LiveRight(HOST, "/n", call, topic) for call in calls for topic in ("/secret", "/plain")]
    (ending,) = endings(POLICY, live)
    assert (ending.host, ending.caller_id, ending.what, ending.resource) == (
        str(HOST), "/n", "subscription", "/secret",
    )  # fmt: skip
    assert "/secret" in ending.reason
