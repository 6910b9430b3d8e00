"""Names of hosts: `robot`, the groups of the policy, and enrolled hosts. Only this module resolves them.

A name means every network of its group, at any depth, and the enrolled host of this name. `host:NAME` means only the
enrolled host, `door:NAME` the door. The label of an address is the name of the smallest network that contains it: of
an enrolled host before `robot`, and of `robot` before the group with the fewest networks. A network of all addresses
gives no label.
"""

import contextlib
import ipaddress
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from appliance.base.validation_messages import meant
from appliance.policy.groups import ROBOT
from appliance.policy.host_sets import Network, canonical_address, canonical_network
from appliance.policy.ini_reader import read
from appliance.policy.model import DOOR, HOST, Address, known_name, plain_address
from appliance.policy.policy_findings import Findings, quote
from appliance.policy.sections import GROUPS

HostInWords = Callable[[str], str]
"""Returns a host as text for people: `tablet (10.0.0.7)`, or the address alone."""

_MAX_NAMED = 20
_LONGEST_NAME = 300
_MAX_SHOWN = 5  # networks of a name
_EVERY = tuple(map(ipaddress.ip_network, ("0.0.0.0/0", "::/0")))


class UnknownHostNameError(ValueError):
    """No host has this name, or not one alone; the message has the nearest known name, or its addresses."""


@dataclass(frozen=True)
class HostNames:
    """The names of a policy; `robot` is one of the groups."""

    groups: Mapping[str, tuple[Network, ...]]
    enrolled: Mapping[str, Address]

    @classmethod
    def of(cls, text: str, enrolled: Mapping[str, Address], robot: Iterable[Network]) -> "HostNames":
        rows = {
            entry.key.text: [word.text for word in entry.values]
            for section in read(text, Findings("policy"))
            if section.is_named(GROUPS)
            for entry in section.entries
        }
        groups = {ROBOT: tuple(robot)}
        for name in rows:
            _define(name, rows, groups, enrolled)
        return cls(groups, enrolled)

    def networks(self, text: str) -> tuple[Network, ...]:
        try:
            return (canonical_network(ipaddress.ip_network(text)),)
        except ValueError:
            name = known_name(text) or text
        found = dict.fromkeys(self.groups.get(text, ()))
        if name in self.enrolled:
            found[_network_of(self.enrolled[name])] = None
        if not found:
            raise UnknownHostNameError(self._unknown(text, name))
        return tuple(found)

    def host(self, text: str) -> Address:
        """Return the one host that an order names. Raises `UnknownHostNameError`, also for a network or several."""
        with contextlib.suppress(ValueError):
            return plain_address(str(ipaddress.ip_address(text)))
        networks = self.networks(text[:_LONGEST_NAME])
        if len(networks) > 1 or networks[0].num_addresses > 1:
            some = [
                str(network).removesuffix("/32").removesuffix("/128") for network in networks[:_MAX_SHOWN]
            ]
            shown = "" if "/" in text else f" ({', '.join(some)})"
            raise UnknownHostNameError(f"{text[:80]!r} is not one host: give one address{shown}")
        return plain_address(str(networks[0].network_address))

    def _unknown(self, text: str, name: str) -> str:
        if text in self.groups:
            return f"the address of {text} is not known"
        if text.startswith(DOOR):
            return f"there is no door {quote(text.removeprefix(DOOR))}{meant(name, self.enrolled)}"
        if text.startswith(HOST):
            return f"no host {quote(name)} is enrolled{meant(name, self.enrolled)}"
        known = [*self.groups, *self.enrolled]
        guess = meant(text, known) or f"; the names are {', '.join(known[:_MAX_NAMED])}"
        return f"{quote(text)} is not an address, nor the name of a group or an enrolled host{guess}"

    def labels(self) -> list[tuple[Network, str]]:
        rows = [(-1, _network_of(address), name) for name, address in self.enrolled.items()]
        rows += [
            (0 if name == ROBOT else len(some), one, name)
            for name, some in self.groups.items()
            for one in some
        ]
        rows = [row for row in rows if row[1] not in _EVERY]
        return [
            (network, name)
            for _size, network, name in sorted(rows, key=lambda row: (-row[1].prefixlen, row[0]))
        ]


def label_of(address: str, labels: Iterable[tuple[Network, str]]) -> str:
    try:
        found = canonical_address(ipaddress.ip_address(address))
    except ValueError:
        return ""
    return next((name for network, name in labels if found in network), "")


def in_words(address: str, labels: Iterable[tuple[Network, str]]) -> str:
    name = label_of(address, labels)
    return f"{name} ({address})" if name else address


def _define(
    name: str,
    rows: Mapping[str, list[str]],
    groups: dict[str, tuple[Network, ...]],
    enrolled: Mapping[str, Address],
) -> tuple[Network, ...]:
    if name not in groups:
        groups[name] = ()  # a valid policy has no cycle
        found: dict[Network, None] = {}
        for word in rows[name]:
            found |= dict.fromkeys(
                _define(word, rows, groups, enrolled)
                if word in rows or word in groups
                else _meant_by(word, enrolled)
            )
        groups[name] = tuple(found)
    return groups[name]


def _meant_by(word: str, enrolled: Mapping[str, Address]) -> tuple[Network, ...]:
    if word == "*":
        return _EVERY
    known = known_name(word)
    if known is not None:
        address = enrolled.get(known)
        return () if address is None else (_network_of(address),)
    try:
        return (canonical_network(ipaddress.ip_network(word)),)
    except ValueError:
        return ()


def _network_of(address: Address) -> Network:
    return canonical_network(ipaddress.ip_network(canonical_address(address)))
