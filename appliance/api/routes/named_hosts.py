"""Names of hosts by the policy in force: resolve the names in a search, and label addresses."""

import ipaddress
from functools import partial
from typing import Annotated

import msgspec

from appliance.audit.search.query import Filter, FilterError, network_of
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.policy.host_names import HostInWords, HostNames, UnknownHostNameError, in_words
from appliance.policy.model import address_of

_GLOB = frozenset("*?[")


class HostLabel(msgspec.Struct, frozen=True):
    """The name of the addresses in a network."""

    network: Annotated[str, msgspec.Meta(description="an address with its prefix length")]
    name: Annotated[str, msgspec.Meta(description="an enrolled host, `robot`, or a group of the policy")]


class HostLabels(msgspec.Struct, frozen=True):
    """The names of hosts by the policy in force: the first network that contains an address gives its name."""

    labels: Annotated[list[HostLabel], msgspec.Meta(description="the smallest network first")]


def names_of(known: PolicyInForce) -> HostNames:
    enrolled = {name: address_of(address) for name, address in known.hosts.items()}
    return HostNames.of(known.text, enrolled, map(ipaddress.ip_network, known.robot))


def labels_of(known: PolicyInForce) -> HostLabels:
    return HostLabels([HostLabel(str(network), name) for network, name in names_of(known).labels()])


def host_in_words(known: PolicyInForce | None) -> HostInWords:
    return str if known is None else partial(in_words, labels=names_of(known).labels())


def has_name(wanted: Filter) -> bool:
    """Return whether the search needs the policy; addresses, networks and globs do not."""
    host = wanted.host
    if host is None or not _GLOB.isdisjoint(host) or network_of(host) is not None:
        return False
    try:
        host.encode()
    except UnicodeEncodeError:
        return False  # the search rejects it
    return True


def with_networks(wanted: Filter, known: PolicyInForce) -> Filter:
    """Replace the host's name with its networks. Raises `FilterError` for an unknown name."""
    try:
        networks = names_of(known).networks(wanted.host or "")
    except UnknownHostNameError as error:
        raise FilterError(f"host: {error}") from None
    return msgspec.structs.replace(wanted, host=None, hosts=tuple(map(str, networks)))
