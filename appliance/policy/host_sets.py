"""Store networks and groups as numbers, and find the numbers for an address with a prefix table.

A host has the numbers (*atoms*) of all networks that contain its address, and of all groups that contain these
networks. A rule includes a host if they share an atom, so cost does not grow with the size of groups.
"""

import ipaddress
from collections.abc import Container, Iterable
from typing import Final

from appliance.policy.model import Address

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
Atom = int

EVERYONE: Final[Atom] = 0
"""The atom of `*`, which every host has."""

_BITS = {4: 32, 6: 128}


def canonical_address(address: Address) -> Address:
    if isinstance(address, ipaddress.IPv6Address):
        return address.ipv4_mapped or address
    return address


def canonical_network(network: Network) -> Network:
    if isinstance(network, ipaddress.IPv6Network) and network.prefixlen >= 96:
        mapped = network.network_address.ipv4_mapped
        if mapped is not None:
            return ipaddress.IPv4Network((int(mapped), network.prefixlen - 96))
    return network


class HostSets:
    """The networks and groups of a policy, which do not change after it is compiled."""

    __slots__ = ("_lengths", "_networks", "_parents", "_tables")

    def __init__(self) -> None:
        self._parents: list[list[Atom]] = [[]]  # the groups of each atom; atom 0 is EVERYONE
        self._networks: dict[Network, Atom] = {}
        # version -> prefix length -> leading bits -> atom of the network
        self._tables: dict[int, dict[int, dict[int, Atom]]] = {4: {}, 6: {}}
        self._lengths: dict[int, list[tuple[int, dict[int, Atom]]]] = {4: [], 6: []}

    def network(self, network: Network) -> Atom:
        network = canonical_network(network)
        atom = self._networks.get(network)
        if atom is None:
            atom = self._networks[network] = self.group()
            shift = _BITS[network.version] - network.prefixlen
            bits = int(network.network_address) >> shift
            table = self._tables[network.version].setdefault(network.prefixlen, {})
            table[bits] = atom
            self._lengths[network.version] = [
                (_BITS[network.version] - length, entries)
                for length, entries in self._tables[network.version].items()
            ]
        return atom

    def group(self) -> Atom:
        self._parents.append([])
        return len(self._parents) - 1

    def put(self, members: Iterable[Atom], group: Atom) -> None:
        for member in members:
            self._parents[member].append(group)

    def parents(self, atom: Atom) -> list[Atom]:
        return self._parents[atom]

    def atoms_of(self, address: Address, closed: Container[Atom] = ()) -> frozenset[Atom]:
        """Return the atoms of an address; none through the atoms `closed`."""
        address = canonical_address(address)
        number = int(address)
        waiting = [EVERYONE]
        for shift, table in self._lengths[address.version]:
            atom = table.get(number >> shift)
            if atom is not None:
                waiting.append(atom)
        return self.above(waiting, closed)

    def narrowest(self, address: Address) -> Network | None:
        plain = canonical_address(address)
        bits, number = _BITS[plain.version], int(plain)
        shifts = [shift for shift, table in self._lengths[plain.version] if number >> shift in table]
        if not shifts:
            return None
        network = ipaddress.IPv4Network if plain.version == 4 else ipaddress.IPv6Network
        return network((number >> min(shifts) << min(shifts), bits - min(shifts)))

    def above(self, atoms: Iterable[Atom], closed: Container[Atom] = ()) -> frozenset[Atom]:
        """Return the atoms and every group that contains one of them, at any depth."""
        waiting = list(atoms)
        found = set(waiting)
        while waiting:
            for parent in self._parents[waiting.pop()]:
                if parent not in found and parent not in closed:
                    found.add(parent)
                    waiting.append(parent)
        return frozenset(found)

    def networks(self) -> dict[Network, Atom]:
        return dict(self._networks)
