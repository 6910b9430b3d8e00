import errno
import json
import subprocess
import sys
from typing import Any

import pytest

from appliance.network.firewall.backend import BackendMissingError, FirewallError
from appliance.network.firewall.firewall import statuses
from appliance.network.firewall.firewall_rules import (
    Chain,
    FirewallSettings,
    PacketRule,
    PacketVerdict,
    PortRange,
    RateLimit,
    appliance_rules,
    inner_port,
)
from appliance.network.firewall.nft import NftBackend, render, render_rule
from appliance.network.namespaces import Namespace

PORT = {"match": {"op": "==", "left": {"payload": {"protocol": "tcp", "field": "dport"}}, "right": 11312}}
SYN = {
    "match": {
        "op": "==",
        "left": {"&": [{"payload": {"protocol": "tcp", "field": "flags"}}, {"|": ["syn", "ack"]}]},
        "right": "syn",
    }
}


def test_the_owner_rule_in_libnftables_json() -> None:
    _, owner, others = inner_port("ROS master port", 11312, "control", 61011)
    assert render_rule(owner) == [
        {
            "chain": "ROSRV-OUT",
            "expr": [
                {"match": {"op": "==", "left": {"meta": {"key": "oifname"}}, "right": "lo"}},
                PORT,
                SYN,
                {"match": {"op": "==", "left": {"meta": {"key": "skuid"}}, "right": 61011}},
                {"counter": None},
                {"return": None},
            ],
            "comment": "ROS master port: control may",
        }
    ]
    assert render_rule(others)[0]["expr"][-1] == {"reject": {"type": "tcp reset"}}


def test_each_chain_is_jumped_to_from_its_hooks() -> None:
    commands = render(appliance_rules(FirewallSettings(control_uid=1, rosmaster_uid=2, rosmaster_port=11312)))
    added = [command["add"] for command in commands]
    chains = {body["chain"]["name"]: body["chain"] for body in added if "chain" in body}
    assert set(chains) == {"ROSRV-IN", "ROSRV-OUT", "ROSRV-IN-INPUT", "ROSRV-OUT-OUTPUT"}
    assert {chain["policy"] for chain in chains.values() if "hook" in chain} == {"accept"}
    jumps = [
        part["jump"]["target"]
        for command in commands
        if "rule" in command["add"]
        for part in command["add"]["rule"]["expr"]
        if "jump" in part
    ]
    assert sorted(jumps) == ["ROSRV-IN", "ROSRV-OUT"]


def test_translation_is_hooked_for_the_network_and_for_the_host_itself() -> None:
    rule = PacketRule(
        chain=Chain.NAT, purpose="p", verdict=PacketVerdict.DNAT, tcp_ports=PortRange(5, 9), to="fd00::2"
    )
    commands = render((rule,))
    hooks = {one["add"]["chain"]["hook"] for one in commands if "hook" in one["add"].get("chain", {})}
    assert hooks == {"prerouting", "output"}
    (body,) = render_rule(rule)
    assert body["expr"][-1] == {"dnat": {"family": "ip6", "addr": "fd00::2"}}
    assert body["expr"][0]["match"]["right"] == "ipv6"


def test_a_rate_limit_has_one_set_for_each_family() -> None:
    rules = tuple(
        PacketRule(
            chain=Chain.IN,
            purpose=f"p{port}",
            verdict=PacketVerdict.DROP,
            tcp_ports=PortRange.one(port),
            answered=True,
            above=RateLimit(10, 20),
        )
        for port in (1, 2)
    )
    sets = [one["add"]["set"] for one in render(rules) if "set" in one["add"]]
    assert [(one["name"], one["type"], one["size"]) for one in sets] == [
        ("new-ipv4-10-20", "ipv4_addr", 65535),
        ("new-ipv6-10-20", "ipv6_addr", 65535),
    ]


def listed(rules: tuple[PacketRule, ...], *, without: int | None = None) -> str:
    bodies = [one["add"]["rule"] for one in render(rules) if "rule" in one["add"]]
    jumps = [body for body in bodies if "comment" not in body]
    kept = [
        body for number, body in enumerate(body for body in bodies if "comment" in body) if number != without
    ]
    for number, body in enumerate(kept):
        body["expr"] = [
            {"counter": {"packets": number + 1, "bytes": 100}} if "counter" in part else part
            for part in body["expr"]
        ]
    return json.dumps(
        {
            "nftables": [
                {"table": {"family": "inet", "name": "rosrv"}},
                *({"rule": body} for body in jumps + kept),
            ]
        }
    )


@pytest.mark.nightly
def test_a_rate_limit_is_in_force_with_all_its_rules_only() -> None:
    rule = PacketRule(
        chain=Chain.IN,
        purpose="p",
        verdict=PacketVerdict.DROP,
        tcp_ports=PortRange.one(1),
        answered=True,
        above=RateLimit(10, 20),
    )
    (status,) = statuses((rule,), NftBackend(Machine(listed((rule,)))).counters())
    assert (status.in_force, status.packets) == (True, 1 + 2 + 3 + 4)
    for gone in range(4):
        (status,) = statuses((rule,), NftBackend(Machine(listed((rule,), without=gone))).counters())
        assert not status.in_force


def test_ipsec_is_matched_as_each_hook_knows_it() -> None:
    keys = []
    for chain in (Chain.IN, Chain.OUT):
        rule = PacketRule(
            chain=chain, purpose="p", verdict=PacketVerdict.DROP, source="10.9.9.1", clear_text=True
        )
        (body,) = render_rule(rule)
        keys.append(body["expr"][2]["match"]["left"])
    assert keys == [{"meta": {"key": "ipsec"}}, {"rt": {"key": "ipsec"}}]


class Machine(Namespace):
    def __init__(self, nft: OSError | str) -> None:
        super().__init__("machine")
        self.nft = nft

    def popen(self, args: Any, **options: Any) -> "subprocess.Popen[Any]":
        if isinstance(self.nft, OSError):
            raise self.nft
        return subprocess.Popen([sys.executable, "-c", f"print({self.nft!r})"], **options)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("nft", "said"),
    [
        (OSError(errno.EAGAIN, "Resource temporarily unavailable"), "Resource temporarily unavailable"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
        ("{", "not JSON"),
        ('{"something": []}', "unknown form"),
        ('{"nftables": [7]}', "unknown form"),
    ],
)
def test_an_nft_that_does_not_run_is_an_error_of_the_firewall(nft: OSError | str, said: str) -> None:
    with pytest.raises(FirewallError, match=said) as caught:
        NftBackend(Machine(nft)).counters()
    assert not isinstance(caught.value, BackendMissingError)


def test_a_missing_nft_selects_another_back_end() -> None:
    with pytest.raises(BackendMissingError, match="apt install nftables"):
        NftBackend(Machine(FileNotFoundError(errno.ENOENT, "no such file"))).remove()
