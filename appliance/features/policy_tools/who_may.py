"""List the hosts that may do something: each network that the policy names, and all other hosts."""

import functools
import ipaddress
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from appliance.policy.host_sets import Network
from appliance.policy.model import Address, Category, Decision, Request, word_of
from appliance.policy.policy import Policy
from appliance.policy.rights import decide, decide_right, rights_of


@dataclass(frozen=True, slots=True)
class HostAnswer:
    network: Network | None
    """None: all hosts that no network of the policy contains."""
    names: tuple[str, ...]
    decision: Decision
    through: tuple[str, ...]
    """The words of the deciding rule."""
    near: bool
    """Whether only another right is missing, such as the right to the command."""

    @property
    def hosts(self) -> str:
        if self.network is None:
            return "every other host"
        return str(
            self.network.network_address
            if self.network.prefixlen == self.network.max_prefixlen
            else self.network
        )


def who_may(policy: Policy, category: Category, resource: str, node: str = "") -> Iterator[HostAnswer]:
    """Yield networks in order of addresses, then all other hosts.

    Without the name of a `node`, the right to a node's name is not decided. Blocks of hosts, approvals, and
    the holders of groups are ignored.

    """
    policy = policy.plain()
    networks = sorted(policy.hosts.networks(), key=lambda one: (one.version, one))
    inside = [
        (network, _only_in(policy, network, networks[place:]))
        for place, network in enumerate(networks, start=1)
    ]
    found: list[tuple[Network | None, Address | None]] = [*inside, (None, _outside(policy, networks))]
    for network, address in found:
        if address is not None:
            yield _answer(policy, network, Request(address, node, category, resource))


def _answer(policy: Policy, network: Network | None, request: Request) -> HostAnswer:
    rights = [
        right
        for right in rights_of(request)
        if right.request.category is not Category.NODE or right.request.resource
    ]
    decision, own = decide(policy, rights), decide_right(policy, rights[0])
    rule = next((one for one in policy.rules(request.category) if one.rule == own.rule), None)
    through = rule.granted_through(policy.atoms_of(request.host)) if rule is not None else ()
    near = own.allowed and not own.would_deny and (not decision.allowed or decision.would_deny)
    return HostAnswer(network, _names(policy, network), decision, through, near)


def _names(policy: Policy, network: Network | None) -> tuple[str, ...]:
    names = [word_of(name) for name, at in policy.enrolled.items() if network == ipaddress.ip_network(at)]
    return tuple((["robot"] if network in policy.robot else []) + sorted(names))


def _only_in(policy: Policy, network: Network, later: list[Network]) -> Address | None:
    """Return an address that no smaller network contains.

    `later` are in order of addresses, so smaller networks follow.

    """
    smaller = itertools.takewhile(functools.partial(_within, network), later)
    starts = itertools.chain([network.network_address], _ends(smaller))
    return next((one for one in starts if one in network and policy.named_as(one) == network), None)


def _within(outer: Network, inner: Network) -> bool:
    return inner.version == outer.version and inner.network_address in outer


def _outside(policy: Policy, networks: list[Network]) -> Address | None:
    starts: list[Address] = [
        ipaddress.IPv4Address(0),
        *_ends([network for network in networks if network.version == 4]),
        ipaddress.IPv6Address(0),
        *_ends([network for network in networks if network.version == 6]),
    ]
    return next((one for one in starts if not policy.names(one)), None)


def _ends(networks: Iterable[Network]) -> Iterator[Address]:
    for network in networks:
        last = network.broadcast_address
        if int(last) + 1 < 1 << network.max_prefixlen:
            yield last + 1
