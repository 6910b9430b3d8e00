"""Tests of the list of hosts that may do something, against the decision on each host."""

import ipaddress

import pytest

from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import decide, rights_of
from appliance.policy.who_may import who_may

POLICY = """\
[Groups]
halves = 10.0.0.0/31 10.0.0.2/31
v6 = 2001:db8::/127 ::/128
[Nodes]
default = *
[Publishers]
/covered = 10.0.0.0/30
/halves = halves 0.0.0.0/1
/six = v6 255.255.255.255
default = *
[Commands]
default = *
"""
HOSTS = [
    *("0.0.0.0", "10.0.0.0", "10.0.0.1", "10.0.0.3", "10.0.0.4", "127.255.255.255", "128.0.0.0"),
    *("255.255.255.255", "::", "::1", "2001:db8::1", "2001:db8::2"),
]


@pytest.mark.parametrize("topic", ["/covered", "/halves", "/six", "/other"])
def test_the_answer_for_a_network_is_the_decision_on_each_host_in_it(topic: str) -> None:
    """The answer for the smallest network with a host, or for all other hosts, is the decision on this host."""
    policy = compile_policy(POLICY, file="p.ini")
    answers = {answer.network: answer for answer in who_may(policy, Category.PUBLISH, topic, "/n")}
    assert ipaddress.ip_network("10.0.0.0/30") not in answers, "smaller networks cover it"
    for text in HOSTS:
        host = ipaddress.ip_address(text)
        network = policy.named_as(host) if policy.names(host) else None
        decided = decide(policy, rights_of(Request(host, "/n", Category.PUBLISH, topic)))
        assert answers[network].decision.allowed == decided.allowed, text
        assert answers[network].decision.rule == decided.rule


def test_no_answer_for_other_hosts_if_the_networks_are_all() -> None:
    """If the networks of the policy contain every address, there are no other hosts."""
    policy = compile_policy("[Nodes]\ndefault = 0.0.0.0/0 ::/0\n", file="p.ini")
    assert [answer.hosts for answer in who_may(policy, Category.NODE, "/n")] == ["0.0.0.0/0", "::/0"]
