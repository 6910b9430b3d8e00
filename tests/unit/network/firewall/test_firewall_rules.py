from dataclasses import fields, replace
from typing import Any

import pytest

from appliance.network.firewall import iptables, nft
from appliance.network.firewall.backend import RuleCounter
from appliance.network.firewall.firewall import statuses
from appliance.network.firewall.firewall_rules import (
    Chain,
    FirewallSettings,
    ForwarderAccess,
    Interface,
    OwnNetworkAccess,
    OwnNodeAccess,
    PacketRule,
    PacketVerdict,
    PeerAccess,
    PortRange,
    RateLimit,
    appliance_rules,
    family_of,
    inner_port,
)
from appliance.network.listening_sockets import TcpSocket

OWN_NODE = OwnNodeAccess(
    uid=61018, relay_uid=61013, address="127.87.79.1", ports=PortRange(900, 963), master_port=5555
)
FULL = FirewallSettings(
    control_uid=61011,
    rosmaster_uid=61012,
    rosmaster_port=11312,
    inner_port=4444,
    node_ports=PortRange(20000, 20099),
    api_port=8443,
    api_networks=("10.0.0.0/8", "fd00::/8"),
    tunnel_only=("10.9.9.1", "fd77::1"),
    own_node=OWN_NODE,
)
BARE = FirewallSettings(control_uid=1, rosmaster_uid=2, new_connections=None)
DROPPED = PacketRule(chain=Chain.IN, purpose="p", verdict=PacketVerdict.DROP)
DOORS = OwnNetworkAccess("198.19.240.0/20", relay_uid=61013)


def test_no_other_machine_uses_or_reaches_the_own_network() -> None:
    settings = replace(FULL, own_network=DOORS, own_ports=(PortRange.one(9091),))
    rules = appliance_rules(settings)
    added = [rule for rule in rules if rule not in appliance_rules(FULL)]
    first, second, *_limits = added
    assert (first.source, second.destination) == ("198.19.240.0/20", "198.19.240.0/20")
    for rule in (first, second):
        assert (rule.verdict, rule.chain) == (PacketVerdict.DROP, Chain.IN)
        assert rule.arrives_on == Interface("lo", other=True)
        assert not rule.is_tcp
    passed = next(rule for rule in rules if rule.verdict is PacketVerdict.RETURN and rule.chain is Chain.IN)
    assert rules.index(passed) > rules.index(second)
    assert any(rule.above for rule in added if rule.tcp_ports == PortRange.one(9091))


OUTSIDE, BOX, DOOR, ANY = "10.0.0.66", "10.0.0.2", "198.19.240.2", 61000
OPENED = {
    "a door's node": (BOX, 40001, DOOR, 40002, ANY),
    "as a door": (DOOR, 40001, BOX, 11311, ANY),
    "ROS master": ("127.0.0.1", 40001, "127.0.0.1", 11312, ANY),
    "the own node's API": ("127.0.0.1", 40001, OWN_NODE.address, 40002, ANY),
    "RVMaster, from the own node": (BOX, 40001, BOX, 11311, OWN_NODE.uid),
}
ACCEPTED = {
    "REST": (BOX, 8443, OUTSIDE, 40001, ANY),
    "ROS master, from outside": (BOX, 11312, OUTSIDE, 40001, ANY),
    "a port of the kernel's choice": (BOX, 40002, OUTSIDE, 40001, ANY),
    "the own node, by another address": ("127.0.0.1", 40002, "127.0.0.1", 40001, OWN_NODE.uid),
    "a listener as a door": (DOOR, 40002, BOX, 40001, ANY),
    "the other appliance": (BOX, 7100, OUTSIDE, 40001, ANY),
}
PERMITTED = {
    "RVMaster": (True, (BOX, 11311, OUTSIDE, 40001, ANY)),
    "a relay": (True, (BOX, 20001, OUTSIDE, 40001, ANY)),
    "a door": (True, (BOX, 9091, OUTSIDE, 40001, ANY)),
    "a node of this machine": (True, ("127.0.0.1", 40002, "127.0.0.1", 40001, ANY)),
    "a node of another one": (False, (BOX, 40001, OUTSIDE, 40002, FULL.control_uid)),
    "the port of ROS master elsewhere": (False, (BOX, 40001, OUTSIDE, 11312, ANY)),
}
ENDS = [
    *((name, False, True, ends) for name, ends in OPENED.items()),
    *((name, True, True, ends) for name, ends in ACCEPTED.items()),
    *((name, accepted, False, ends) for name, (accepted, ends) in PERMITTED.items()),
]


@pytest.mark.parametrize(
    ("accepted", "refused", "ends"), [row[1:] for row in ENDS], ids=[row[0] for row in ENDS]
)
def test_a_connection_that_begins_without_the_rules_is_known_by_them(
    accepted: bool, refused: bool, ends: tuple[str, int, str, int, int]
) -> None:
    settings = replace(
        FULL, own_network=DOORS, own_ports=(PortRange.one(9091),), client_ports=PortRange(32768, 60999),
        peer=PeerAccess("10.0.0.3", 7100),
    )  # fmt: skip
    address, port, peer, peer_port, uid = ends
    one = TcpSocket(4, address, port, peer, peer_port, False, True, "7", uid=uid)
    near = peer != OUTSIDE
    assert (
        any(rule.refuses(one, accepted=accepted, near=near) for rule in appliance_rules(settings)) is refused
    )


def test_the_addresses_of_doors_are_bound_to_control() -> None:
    """In each direction, the users that may come first, and all others are refused."""
    rules = appliance_rules(replace(FULL, own_network=DOORS))
    sent = [
        (
            "to" if rule.destination else "from",
            "syn" if rule.opening else "syn ack",
            rule.uid,
            rule.verdict,
        )
        for rule in rules
        if rule.chain is Chain.OUT and DOORS.network in (rule.source, rule.destination)
    ]
    assert sent == [
        ("to", "syn", FULL.control_uid, PacketVerdict.RETURN),
        ("to", "syn", DOORS.relay_uid, PacketVerdict.RETURN),
        ("to", "syn", None, PacketVerdict.RESET),
        ("from", "syn", FULL.control_uid, PacketVerdict.RETURN),
        ("from", "syn", None, PacketVerdict.RESET),
        ("from", "syn ack", FULL.control_uid, PacketVerdict.RETURN),
        ("from", "syn ack", None, PacketVerdict.DROP),
    ]


def test_the_rules_only_ever_refuse() -> None:
    """To accept a packet would override another firewall."""
    refusing = {PacketVerdict.RETURN, PacketVerdict.RESET, PacketVerdict.DROP}
    assert {rule.verdict for rule in appliance_rules(FULL)} == refusing | {PacketVerdict.COUNTED}


def test_hosts_are_counted_after_the_handshake_only() -> None:
    limited = [rule for rule in appliance_rules(FULL) if rule.above is not None]
    assert len(limited) == 3
    assert all(rule.answered and not rule.opening for rule in limited)
    with pytest.raises(ValueError, match="sources that have answered"):
        replace(limited[0], answered=False)


def test_the_owner_passes_before_all_others_are_refused() -> None:
    outside, owner, others = inner_port("ROS master port", 11312, "control", 61011)
    assert (outside.chain, outside.arrives_on, outside.verdict) == (
        Chain.IN,
        Interface("lo", other=True),
        PacketVerdict.RESET,
    )
    assert (owner.chain, owner.uid, owner.verdict) == (Chain.OUT, 61011, PacketVerdict.RETURN)
    assert (others.chain, others.uid, others.verdict) == (Chain.OUT, None, PacketVerdict.RESET)
    assert all(
        rule.opening and rule.tcp_ports == PortRange(11312, 11312) for rule in (outside, owner, others)
    )


def test_unknown_ports_and_empty_lists_make_no_rule() -> None:
    assert appliance_rules(BARE) == ()


def test_an_address_of_the_machine_is_for_its_own_packets() -> None:
    first, second, *_ = appliance_rules(replace(FULL, neighbours=("10.111.0.1", "fd52::1")))
    assert [rule.families() for rule in (first, second)] == [(4,), (6,)]
    assert all(
        rule.distant and rule.opening and rule.verdict is PacketVerdict.DROP for rule in (first, second)
    )


def test_a_tunnelled_address_is_refused_both_ways_before_all_else() -> None:
    first, second = appliance_rules(FULL)[:2]
    assert (first.source, first.clear_text, first.verdict) == ("10.9.9.1", True, PacketVerdict.DROP)
    assert (second.destination, second.clear_text, second.chain) == ("10.9.9.1", True, Chain.OUT)
    first, second = appliance_rules(replace(BARE, tunnel_only=("10.9.9.1",), tunnel_interface="ipsec0"))
    assert (first.arrives_on, first.clear_text) == (Interface("ipsec0", other=True), False)
    assert (second.leaves_on, second.clear_text) == (Interface("ipsec0", other=True), False)


def test_the_rest_port_is_limited_before_its_networks_pass() -> None:
    purposes = [rule.purpose for rule in appliance_rules(FULL) if rule.purpose.startswith("REST")]
    assert purposes == [
        "REST port: new connections per host",
        "REST port: counted",
        "REST port: 10.0.0.0/8 may",
        "REST port: fd00::/8 may",
        "REST port: no other network",
    ]


def test_purposes_tell_rules_of_a_chain_apart() -> None:
    """Counters are matched by purpose."""
    keys = [(rule.chain, rule.purpose) for rule in appliance_rules(FULL)]
    assert len(keys) == len(set(keys))


def test_families_follow_the_addresses() -> None:
    assert replace(DROPPED, source="fd00::/8").families() == (6,)
    assert DROPPED.families() == (4, 6)
    assert family_of("10.0.0.0/8") == 4


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PortRange(0, 5), "0-5 is not a range"),
        (lambda: PortRange(9, 5), "9-5 is not a range"),
        (lambda: PortRange(1, 65536), "1-65536 is not a range"),
        (lambda: RateLimit(0, 5), "1 to 100000"),
        (lambda: replace(BARE, control_uid=-1), "control_uid -1"),
        (lambda: replace(BARE, rosmaster_port=70000), "70000"),
        (lambda: replace(BARE, api_networks=("ten",)), "'ten' is not an address"),
        (lambda: replace(BARE, tunnel_only=("10.0.0.1/8",)), "'10.0.0.1/8' is not an address"),
        (lambda: replace(OWN_NODE, uid=-1), "own node: -1"),
        (lambda: replace(OWN_NODE, address="here"), "'here' is not an address"),
        (lambda: replace(DROPPED, verdict=PacketVerdict.RESET), "only TCP can be reset"),
        (lambda: replace(DROPPED, uid=5), "has an owner"),
        (lambda: replace(DROPPED, chain=Chain.NAT, verdict=PacketVerdict.DNAT), "DNAT and its address"),
    ],
)
def test_wrong_values_are_named(make: object, words: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=words):
        make()


def test_a_rule_is_in_force_only_with_all_its_families() -> None:
    four = RuleCounter("ROSRV-IN", 4, "p", 3, 300)
    six = RuleCounter("ROSRV-IN", 6, "p", 1, 100)
    (status,) = statuses((DROPPED,), (four, six))
    assert (status.packets, status.octets, status.in_force) == (4, 400, True)
    assert not statuses((DROPPED,), (four,))[0].in_force
    assert statuses((DROPPED,), (RuleCounter("ROSRV-IN", None, "p", 0, 0),))[0].in_force
    assert not statuses((DROPPED,), (RuleCounter("ROSRV-OUT", None, "p", 0, 0),))[0].in_force


def test_a_kernel_without_a_family_lacks_no_rule_of_it() -> None:
    both, six = DROPPED, replace(DROPPED, purpose="six", source="fd00::/8")
    four = RuleCounter("ROSRV-IN", 4, "p", 3, 300)
    assert [status.in_force for status in statuses((both, six), (four,), families=(4,))] == [True, True]
    assert [status.in_force for status in statuses((both, six), (), families=(4,))] == [False, True]
    assert [status.in_force for status in statuses((both, six), (four,))] == [False, False]


def test_a_rule_describes_itself() -> None:
    _, owner, _ = inner_port("ROS master port", 11312, "control", 61011)
    assert owner.describe() == "out lo, tcp 11312, uid 61011, syn -> RETURN"


def test_ports_of_the_own_nodes_are_closed_from_outside() -> None:
    bare = replace(BARE, client_ports=PortRange(32768, 60999))
    [closed] = appliance_rules(bare)
    assert (closed.chain, closed.verdict, closed.tcp_ports) == (
        Chain.IN,
        PacketVerdict.RESET,
        PortRange(32768, 60999),
    )
    assert closed.arrives_on == Interface("lo", other=True)
    inside = replace(bare, node_ports=PortRange(40000, 40099), master_port=50000)
    *ours, last = appliance_rules(inside)
    assert last == closed
    assert [(rule.verdict, rule.tcp_ports) for rule in ours] == [
        (PacketVerdict.RETURN, PortRange(50000, 50000)),
        (PacketVerdict.RETURN, PortRange(40000, 40099)),
    ]


def test_the_own_node_is_called_by_control_alone() -> None:
    of_node = [rule for rule in appliance_rules(FULL) if "own node" in rule.purpose]
    calls = [rule for rule in of_node if rule.destination == "127.87.79.1"]
    assert [(rule.uid, rule.verdict) for rule in calls] == [
        (61011, PacketVerdict.RETURN),
        (None, PacketVerdict.RESET),
    ]
    assert all(rule.chain is Chain.OUT and rule.tcp_ports == PortRange(1, 65535) for rule in calls)
    answers = [rule for rule in of_node if rule.accepting]
    assert [(rule.source, rule.from_ports, rule.verdict) for rule in answers] == [
        ("127.87.79.1", None, PacketVerdict.RETURN),
        (None, PortRange(900, 963), PacketVerdict.RETURN),
        (None, None, PacketVerdict.DROP),
    ]
    assert {rule.uid for rule in answers} == {61018}
    assert answers[1].describe() == "from tcp 900-963, uid 61018, syn ack -> RETURN"


def test_rosmaster_and_the_own_node_open_no_way_out() -> None:
    rules = appliance_rules(FULL)
    for uid, port in ((61012, 4444), (61018, 5555)):
        opened = [rule for rule in rules if rule.uid == uid and rule.opening]
        passed = {rule.tcp_ports for rule in opened if rule.verdict is PacketVerdict.RETURN}
        assert passed == {PortRange.one(port)}
        assert PacketRule(
            chain=Chain.OUT,
            purpose=opened[0].purpose,
            verdict=PacketVerdict.DROP,
            leaves_on=Interface("lo", other=True),
            uid=uid,
        ) in {replace(rule, purpose=opened[0].purpose) for rule in rules}
    refused = {rule.tcp_ports for rule in rules if rule.uid == 61018 and rule.verdict is PacketVerdict.RESET}
    assert refused == {PortRange.one(11311), PortRange.one(8443), PortRange(1, 1023)}


def test_a_rule_is_for_tcp_or_for_udp() -> None:
    with pytest.raises(ValueError, match="TCP or UDP"):
        replace(DROPPED, tcp_ports=PortRange.one(500), udp_ports=PortRange.one(500))
    assert replace(DROPPED, udp_ports=PortRange.one(500)).describe() == "udp 500 -> DROP"


def test_the_forwarder_reaches_its_receiver_only() -> None:
    for datagrams in (False, True):
        to = ForwarderAccess(61017, "10.0.0.9", 6514, "log", datagrams=datagrams)
        receiver, others = appliance_rules(replace(BARE, forwarders=(to,)))
        assert (receiver.chain, receiver.uid, receiver.destination) == (Chain.OUT, 61017, "10.0.0.9")
        assert receiver.verdict is PacketVerdict.RETURN
        assert receiver.udp_ports == (PortRange.one(6514) if datagrams else None)
        assert receiver.tcp_ports == (None if datagrams else PortRange.one(6514))
        assert others == PacketRule(
            chain=Chain.OUT, purpose=others.purpose, verdict=PacketVerdict.DROP, uid=61017
        )


@pytest.mark.parametrize("wrong", [(-1, "10.0.0.9", 1), (1, "logs.example.com", 1), (1, "10.0.0.9", 0)])
def test_an_invalid_forwarder_is_an_error(wrong: tuple[int, str, int]) -> None:
    with pytest.raises(ValueError, match=r"is not a|port"):
        ForwarderAccess(*wrong, "log")


OUT = PacketRule(chain=Chain.OUT, purpose="p", verdict=PacketVerdict.DROP)
LEAVING = PacketRule(chain=Chain.LEAVING, purpose="p", verdict=PacketVerdict.DROP)
HOLD = PacketRule(chain=Chain.HOLD, purpose="p", verdict=PacketVerdict.DROP, tcp_ports=PortRange.one(7))
NAT = PacketRule(chain=Chain.NAT, purpose="p", verdict=PacketVerdict.DNAT, to="10.0.0.1")
CONDITIONS: dict[str, tuple[PacketRule, Any]] = {
    "family": (OUT, 6), "arrives_on": (OUT, Interface("lo")), "leaves_on": (OUT, Interface("lo", other=True)),
    "source": (OUT, "10.0.0.0/8"), "destination": (OUT, "10.0.0.0/8"), "tcp_ports": (OUT, PortRange.one(7)),
    "udp_ports": (OUT, PortRange.one(7)), "from_ports": (OUT, PortRange.one(7)), "opening": (OUT, True),
    "accepting": (OUT, True), "uid": (OUT, 7), "clear_text": (OUT, True),
    "above": (replace(OUT, answered=True), RateLimit(7, 7)), "local_destination": (OUT, True),
    "local_source": (OUT, True), "forwarded": (LEAVING, True), "distant": (OUT, True), "new_connection": (OUT, True),
    "unknown": (OUT, True), "answered": (OUT, True), "translated": (OUT, True), "to": (NAT, "10.0.0.2"),
    "seconds": (HOLD, 60),
}  # fmt: skip


def test_replication_and_lease_are_for_the_other_appliance() -> None:
    rules = appliance_rules(replace(BARE, peer=PeerAccess("10.0.0.3", 7412)))
    ours = [
        rule
        for rule in rules
        if PortRange.one(7412) in (rule.tcp_ports, rule.udp_ports) and rule.chain is Chain.IN
    ]
    assert [(rule.verdict, rule.source, rule.udp_ports is not None) for rule in ours] == [
        (PacketVerdict.RETURN, "10.0.0.3", False),
        (PacketVerdict.RESET, None, False),
        (PacketVerdict.RETURN, "10.0.0.3", True),
        (PacketVerdict.DROP, None, True),
    ]


@pytest.mark.parametrize("name", [field.name for field in fields(PacketRule)])
def test_both_back_ends_translate_each_condition(name: str) -> None:
    """An ignored condition would match more packets. The other chains need nftables."""
    if name in ("purpose", "verdict", "chain"):
        return
    rule, value = CONDITIONS[name]
    changed = replace(rule, **{name: value})
    assert nft.render_rule(changed) != nft.render_rule(rule)
    if rule.chain is Chain.OUT:
        assert iptables.render_rule(changed) != iptables.render_rule(rule)
    assert name == "family" or changed.describe() != rule.describe()
