from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.network import close_ports, interfaces, isolation
from appliance.network.firewall.backend import RuleCounter
from appliance.network.firewall.firewall_rules import (
    HOOKS,
    Chain,
    Family,
    PacketRule,
    PacketVerdict,
    PortRange,
)
from appliance.network.firewall.nft import NftBackend
from appliance.network.isolation import Isolation, IsolationSettings, LinkAddresses, isolation_rules
from appliance.network.namespaces import Namespace, NetworkError

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


@pytest.mark.parametrize("family", [4, 6])
def test_ports_without_a_listener_are_refused_on_the_host(family: Family) -> None:
    """Another program's chain cannot drop what is not forwarded, and the robot's own master there stays hidden."""
    master = (PortRange.one(11312),)
    refused = tuple((family, ports) for ports in (*master, SETTINGS.ports[1]))
    rules = isolation_rules(replace(SETTINGS, refused=refused), ENDS, (), master=master)
    forwarded = [
        (str(rule.tcp_ports), rule.families()) for rule in rules if rule.verdict is PacketVerdict.DNAT
    ]
    other = (10 - family,)
    assert sorted(forwarded) == sorted(
        [("11311", (4,)), ("11311", (6,)), ("11312", other), ("20000-20099", other)]
    )
    reset = [rule for rule in rules if rule.verdict is PacketVerdict.RESET]
    assert [(str(rule.tcp_ports), rule.families(), rule.chain, rule.opening) for rule in reset] == [
        ("20000-20099", (family,), Chain.IN, True),
        ("11312", (family,), Chain.IN, True),
    ]


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


@pytest.mark.parametrize(
    ("routes", "subnets"),
    [
        ([], ["10.111.0.0/30", "fd52:4f53:5256::/64"]),
        (["10.111.0.0/30", "10.111.0.8/29"], ["10.111.0.4/30", "fd52:4f53:5256::/64"]),
        (["10.111.0.0/24", "fd52:4f53:5256::/56"], ["10.111.1.0/30", "fd52:4f53:5256:100::/64"]),
        (
            ["0.0.0.0/1", "128.0.0.0/1", "2000::/3", "fc00::/7"],
            ["10.111.0.0/30", "fd52:4f53:5256::/64"],
        ),  # VPN
        (["10.0.0.0/8", "10.111.0.1/32"], ["10.111.0.4/30", "fd52:4f53:5256::/64"]),
        (["10.111.0.0/17", "10.111.128.0/17"], []),
        (["10.111.0.0/16"], []),
    ],
)
def test_no_route_of_the_host_keeps_the_appliance_from_starting(
    routes: list[str], subnets: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    isolated = Isolation(Namespace.own(), SETTINGS)
    monkeypatch.setattr(interfaces, "networks", lambda _namespace: routes)
    monkeypatch.setattr(isolated._forwarding, "has_ipv6", lambda: True)
    if subnets:
        isolated._choose_subnets()
        assert [isolated.ends[4].network, isolated.ends[6].network] == subnets
    else:
        with pytest.raises(NetworkError, match="routes to all"):
            isolated._choose_subnets()


_OPEN = "rosrv protect (NOT in force again)"


class Kernel:
    """The rules of the appliance and of `rosrv protect`, as far as `put_rules_back` sees them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rules: tuple[PacketRule, ...] = ()
        self.protection = "table inet rosrv_protect {}"
        self.failing = ""  # the step that fails
        self.forgotten: list[tuple[PacketRule, ...]] = []  # the rules when the connection tracker forgot
        self.isolation = Isolation(Namespace.own(), replace(SETTINGS, master=11312))
        for owner, name, step in (
            (NftBackend, "install", lambda _backend, rules: self._set(rules)),
            (NftBackend, "counters", lambda _backend: tuple(map(self._counter, self.rules))),
            (Namespace, "run", lambda _namespace, work: work()),
            (close_ports, "applied_rules", lambda: self.protection),
            (isolation, "run_nft", lambda _namespace, text: setattr(self, "protection", text)),
            (isolation, "forget_tracked", lambda _namespace, _ports: self.forgotten.append(self.rules)),
            (isolation, "listening_ports", set),
            (isolation, "udp_ports_in_use", set),
        ):
            monkeypatch.setattr(owner, name, self._step(name, step))
        self.isolation.ends = ENDS
        self.isolation._bring()
        assert self.isolation.put_rules_back() == []

    def _step(self, name: str, step: Callable[..., object]) -> Callable[..., object]:
        def taken(*given: object) -> object:
            if name == self.failing:
                raise NetworkError(f"{name} fails")
            return step(*given)

        return taken

    def _set(self, rules: tuple[PacketRule, ...]) -> None:
        self.rules = rules

    def _counter(self, rule: PacketRule) -> RuleCounter:
        return RuleCounter(rule.chain.value, None, rule.purpose, 0, 0)

    def flush(self) -> None:
        self.rules, self.protection = (), ""

    def restored(self) -> list[str]:
        try:
            return self.isolation.put_rules_back()
        except NetworkError:
            return []


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    return Kernel(monkeypatch)


@pytest.mark.parametrize("step", ["", "counters", "install", "applied", "run_nft", "forget_tracked"])
@pytest.mark.parametrize("failures", [1, 3])
def test_a_step_of_the_restoration_that_fails_for_a_time_loses_nothing(
    step: str, failures: int, kernel: Kernel
) -> None:
    kernel.flush()
    kernel.failing = step
    told = [kernel.restored() for _call in range(failures)]
    kernel.failing = ""
    told.append(kernel.restored())
    assert (bool(kernel.rules), bool(kernel.protection)) == (True, True)
    rules = [rule.purpose for rule in kernel.isolation._wanted_rules()]
    told_once = [purpose for one in told for purpose in one if purpose != _OPEN]
    assert sorted(told_once) == sorted([*rules, "rosrv protect"])
    assert (kernel.restored(), kernel.isolation.unprotected) == ([], "")


CHANGES: dict[str, Callable[[Isolation], object]] = {
    "forward_tunnels": Isolation.forward_tunnels,
    "forward_also": lambda one: one.forward_also((PortRange.one(9091),)),
    "forward_master": Isolation.forward_master,
    "withdraw_master": Isolation.withdraw_master,
}


@pytest.mark.parametrize("step", ["install", "forget_tracked"])
@pytest.mark.parametrize("name", CHANGES)
def test_a_change_that_failed_is_made_by_the_next_call(name: str, step: str, kernel: Kernel) -> None:
    if name == "withdraw_master":
        kernel.isolation.forward_master()
    before, kernel.failing = kernel.rules, step
    with pytest.raises(NetworkError):
        CHANGES[name](kernel.isolation)
    kernel.failing = ""
    CHANGES[name](kernel.isolation)
    assert kernel.rules == kernel.isolation._wanted_rules() != before
    assert kernel.forgotten[-1] == kernel.rules


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_that_failed_is_made_by_the_next_check(name: str, kernel: Kernel) -> None:
    if name == "withdraw_master":
        kernel.isolation.forward_master()
    kernel.failing = "install"
    with pytest.raises(NetworkError):
        CHANGES[name](kernel.isolation)
    kernel.failing = ""
    assert kernel.restored() == []
    assert kernel.rules == kernel.isolation._wanted_rules()


def test_closed_ports_that_cannot_be_closed_again_are_reported_until_they_are(kernel: Kernel) -> None:
    """The control group of a rule is gone: the operator applies other rules. No call says that all is well before."""
    kernel.flush()
    kernel.failing = "run_nft"
    assert _OPEN in kernel.restored()
    for _minute in range(3):
        assert kernel.restored() == []
        assert "run_nft fails" in kernel.isolation.unprotected
    kernel.protection = "other rules"
    assert (kernel.restored(), kernel.isolation.unprotected) == ([], "")
    kernel.failing = ""
    kernel.flush()
    assert "rosrv protect" in kernel.restored()
    assert kernel.protection == "other rules"


def test_closed_ports_that_an_operator_opened_stay_open(kernel: Kernel) -> None:
    kernel.protection = ""
    assert kernel.restored() == []
    kernel.flush()
    assert "rosrv protect" not in kernel.restored()
    assert (kernel.protection, kernel.isolation.unprotected) == ("", "")
