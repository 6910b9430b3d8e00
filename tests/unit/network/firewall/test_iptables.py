import sys

import pytest

from appliance.network.firewall.backend import BackendMissingError
from appliance.network.firewall.firewall_rules import (
    Chain,
    Interface,
    PacketRule,
    PacketVerdict,
    PortRange,
    RateLimit,
    inner_port,
)
from appliance.network.firewall.iptables import HeaderMatch, RenderedRule, _library, render_rule

SYN = ("tcp-flags", ("SYN,ACK", "SYN"))


def test_the_owner_rule_in_words_of_xtables() -> None:
    _, owner, others = inner_port("ROS master port", 11312, "control", 61011)
    header = HeaderMatch(protocol="tcp", out_interface="lo")
    assert render_rule(owner) == [
        RenderedRule(
            "ROSRV-OUT",
            family,
            header,
            (
                ("tcp", (("dport", "11312"), SYN)),
                ("owner", (("uid-owner", "61011"),)),
                ("comment", (("comment", "ROS master port: control may"),)),
            ),
            ("RETURN", ()),
        )
        for family in (4, 6)
    ]
    assert render_rule(others)[1].target == ("REJECT", (("reject-with", "tcp-reset"),))


def test_a_rate_limit_is_a_hashlimit_that_ports_share() -> None:
    rules = [
        PacketRule(
            chain=Chain.IN,
            purpose="p",
            verdict=PacketVerdict.DROP,
            arrives_on=Interface("lo", other=True),
            tcp_ports=ports,
            answered=True,
            above=RateLimit(10, 20),
        )
        for ports in (PortRange(1, 1), PortRange(5, 9))
    ]
    first, second = (dict(render_rule(rule)[0].matches) for rule in rules)
    assert first["hashlimit"] == second["hashlimit"]
    assert ("hashlimit-name", "rosrv-10-20") in first["hashlimit"]
    assert second["tcp"] == (("dport", "5:9"),)
    assert second["conntrack"] == (("ctstatus", "ASSURED"), ("ctdir", "ORIGINAL"))
    assert second["connmark"] == (("mark", "0x0/0x40000000"),)
    assert render_rule(rules[0])[0].header.in_interface == "!lo"


def test_ipsec_is_matched_by_policy_in_both_directions() -> None:
    for chain, direction in ((Chain.IN, "in"), (Chain.OUT, "out")):
        rule = PacketRule(
            chain=chain, purpose="p", verdict=PacketVerdict.DROP, source="fd77::1", clear_text=True
        )
        (rendered,) = render_rule(rule)
        assert rendered.family == 6
        assert rendered.header == HeaderMatch(source="fd77::1")
        assert rendered.matches[0] == ("policy", (("dir", direction), ("pol", "none")))


def test_ports_of_udp_are_matched_as_udp() -> None:
    rule = PacketRule(chain=Chain.IN, purpose="p", verdict=PacketVerdict.DROP, udp_ports=PortRange(500, 501))
    rendered = render_rule(rule)[0]
    assert rendered.header.protocol == "udp"
    assert rendered.matches[0] == ("udp", (("dport", "500:501"),))


def test_a_missing_module_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "iptc", None)
    with pytest.raises(BackendMissingError, match=r"iptc\): run scripts/setup in a checkout"):
        _library()
