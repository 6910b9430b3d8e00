from pathlib import Path

import pytest

from appliance.network.firewall.firewall_rules import HOOKS, Chain, Family, PacketVerdict, PortRange
from appliance.network.isolation import IsolationSettings, LinkAddresses, isolation_rules

ENDS: dict[Family, LinkAddresses] = {
    4: LinkAddresses("10.111.0.0/30", "10.111.0.1", "10.111.0.2"),
    6: LinkAddresses("fd52::/64", "fd52::1", "fd52::2"),
}
SETTINGS = IsolationSettings(ports=(PortRange.one(11311), PortRange(20000, 20099)), directory=Path("/run/x"))


def test_each_range_is_forwarded_on_both_families() -> None:
    rules = [rule for rule in isolation_rules(SETTINGS, ENDS, ()) if rule.verdict is PacketVerdict.DNAT]
    assert [(str(rule.tcp_ports), rule.to, rule.local_destination) for rule in rules] == [
        ("11311", "10.111.0.2", True),
        ("20000-20099", "10.111.0.2", True),
        ("11311", "fd52::2", True),
        ("20000-20099", "fd52::2", True),
    ]


def test_only_new_connections_to_the_master_are_forwarded() -> None:
    """A node's old connection to its own master must see its end, and not a reset of the appliance."""
    added = set(isolation_rules(SETTINGS, ENDS, (), master=(PortRange.one(11312),))) - set(
        isolation_rules(SETTINGS, ENDS, ())
    )
    assert {(str(rule.tcp_ports), rule.to, rule.opening) for rule in added} == {
        ("11312", "10.111.0.2", True),
        ("11312", "fd52::2", True),
    }


def test_a_connection_to_the_own_master_that_began_without_the_rules_does_not_go_on() -> None:
    """Only the machine itself and the appliance send packets to that master then, also within a connection."""
    master = (PortRange.one(11312),)
    added = [
        rule
        for rule in isolation_rules(SETTINGS, ENDS, (), master=master, restored=True)
        if rule not in isolation_rules(SETTINGS, ENDS, (), master=master)
    ]
    assert [(str(rule.arrives_on), str(rule.tcp_ports), rule.verdict, rule.opening) for rule in added] == [
        ("lo", "11312", PacketVerdict.RETURN, False),
        (f"not {SETTINGS.link}", "11312", PacketVerdict.DROP, False),
    ]
    assert isolation_rules(SETTINGS, ENDS, (), restored=True) == isolation_rules(SETTINGS, ENDS, ())


def test_tunnels_are_forwarded_on_request() -> None:
    udp = (PortRange.one(500), PortRange.one(4500))
    added = set(isolation_rules(SETTINGS, ENDS, (), udp=udp)) - set(isolation_rules(SETTINGS, ENDS, ()))
    assert {(str(rule.udp_ports), rule.tcp_ports, rule.to) for rule in added} == {
        ("500", None, "10.111.0.2"),
        ("4500", None, "10.111.0.2"),
        ("500", None, "fd52::2"),
        ("4500", None, "fd52::2"),
    }


def test_packets_to_the_appliance_keep_their_source() -> None:
    rules = [rule for rule in isolation_rules(SETTINGS, ENDS, ()) if rule.chain is Chain.KEPT_SOURCE]
    kept = [rule.family for rule in rules if rule.verdict is PacketVerdict.KEEP_SOURCE]
    assert kept == [4, 6]
    assert [rule.source for rule in rules if rule.verdict is PacketVerdict.MASQUERADE] == ["127.0.0.0/8"]
    assert [hook.priority for hook in HOOKS[Chain.KEPT_SOURCE]] == [-199], (
        "the smallest that the kernel takes"
    )


def test_a_host_that_routed_before_is_not_cut_off() -> None:
    purposes = [rule.purpose for rule in isolation_rules(SETTINGS, ENDS, (4,)) if rule.chain is Chain.FORWARD]
    assert "the host is not an IPv6 router" in purposes
    assert "the host is not an IPv4 router" not in purposes


def test_a_port_is_needed() -> None:
    with pytest.raises(ValueError, match="no port"):
        IsolationSettings(ports=())


def test_the_interface_name_fits() -> None:
    assert len(IsolationSettings(ports=SETTINGS.ports, name="a-rather-long-name").link) <= 15
