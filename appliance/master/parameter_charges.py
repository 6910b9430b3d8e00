"""Charge each parameter, and the namespaces that were made for it, to the host that set the parameter.

A *place* is a key where the owner changes. Parameters that no host has set belong to the appliance (loopback).

1. The sum of the weights of all places is the weight of the tree.
2. A place and the nearest place above it have different owners, so even many parameters have few places.
3. Every place except the root is a key of the tree, and is removed from the journal with its key.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, cast

from appliance.policy.model import Address, address_of
from appliance.quotas.pool import Pool
from appliance.rpc.fair_queue import text_weight
from roswire.errors import ProtocolError
from roswire.parameter_tree import Tree, parts_of
from roswire.xmlrpc import Value

APPLIANCE: Address = address_of("127.0.0.1")
NAME_WEIGHT = 40
"""The approximate bytes that a member of a namespace takes in addition to its name and value."""
_VALUE, _TEXT, _ARRAY, _STRUCT = 45, 35, 50, 40  # the additional bytes of other values
_NUMBERS = frozenset({bool, int, float})


class LimitReachedError(Exception):
    """A call would exceed a limit; the message names the limit."""


class OwnersJournal(Protocol):
    """Stores which host owns the parameters below a key, so that it survives a crash of control."""

    def parameter_owned(self, key: str, host: str) -> None:
        """Store a host as the owner of the parameters at this key and below."""

    def parameters_disowned(self, key: str) -> None:
        """Remove the owners at this key and below."""


@dataclass(slots=True)
class _Place:
    """A place, if it has an owner. Otherwise, a key on the path to places below."""

    owner: Address | None = None
    weight: int = 0  # bytes, without the places below
    below: "dict[str, _Place]" = field(default_factory=dict)

    def owned_places(self) -> "Iterator[_Place]":
        if self.owner is not None:
            yield self
        for place in self.below.values():
            yield from place.owned_places()


class ParameterCharges:
    """Charges parameters to a pool of bytes. `owners` has keys and hosts from the journal."""

    def __init__(
        self, pool: Pool[Address], journal: OwnersJournal, owners: Iterable[tuple[str, str]] = ()
    ) -> None:
        self.pool = pool
        self._journal = journal
        self._root = _Place(APPLIANCE)
        for key, host in owners:
            place = self._root
            for part in parts_of(key):
                place = place.below.setdefault(part, _Place())
            place.owner = address_of(host)

    def weights_by_owner(self, parts: Sequence[str], weight: int) -> Mapping[Address, int]:
        path = self._path(parts)
        owner = _owner(_region(path, parts))
        if len(path) <= len(parts):
            return {owner: weight}
        held: Counter[Address] = Counter()
        for place in path[-1].owned_places():
            held[_owner(place)] += place.weight
        held[owner] += weight - held.total()
        return held

    def replace(self, parts: Sequence[str], before: int, after: int, owner: Address) -> None:
        """Charge the owner for the weight `after` at this key (0: the key is deleted)."""
        path = self._path(parts)
        region = _region(path, parts)
        begun = len(path) > len(parts)  # whether the key is a place, or on the path to a place
        place = path[-1] if begun else region
        if parts and place.owner == owner and not (begun and (place.below or not after)):
            place.weight += after - before  # the usual case: no place begins or ends
            self.pool.charge(owner, after - before)
            return
        self._release(parts, before)
        if not parts:
            self._root.owner, self._root.weight = owner, after
            self._journal.parameter_owned("/", str(owner))
        elif after:
            place = _region(self._path(parts), parts)
            if place.owner != owner:
                place = self._root
                for part in parts:
                    place = place.below.setdefault(part, _Place())
                place.owner = owner
                self._journal.parameter_owned(_key(parts), str(owner))
            place.weight += after
        self.pool.charge(owner, after)

    def recount(self, tree: Tree, *, final: bool) -> None:
        self._recount(self._root, tree, measure(tree)[0], (), final=final)

    def _release(self, parts: Sequence[str], weight: int) -> None:
        path = self._path(parts)
        region = _region(path, parts)
        for owner, amount in self.weights_by_owner(parts, weight).items():
            self.pool.give_back(owner, amount)
        inside = sum(place.weight for place in path[-1].owned_places()) if len(path) > len(parts) else 0
        region.weight -= weight - inside
        if len(path) <= len(parts):
            return
        self._journal.parameters_disowned(_key(parts))
        path[-1].below.clear()
        path[-1].owner = None if parts else path[-1].owner
        for depth in range(len(parts), 0, -1):
            if path[depth].below or path[depth].owner is not None:
                return
            del path[depth - 1].below[parts[depth - 1]]

    def _recount(
        self, place: _Place, value: Value, weight: int, parts: tuple[str, ...], *, final: bool
    ) -> int:
        owned = 0
        for name, below in list(place.below.items()):
            there = isinstance(value, dict) and name in value
            if there or not final:
                member = value[name] if isinstance(value, dict) and there else {}
                size = member_weight(name, member) if there else 0
                owned += self._recount(below, member, size, (*parts, name), final=final)
            else:
                for gone in below.owned_places():
                    self.pool.give_back(_owner(gone), gone.weight)
                del place.below[name]
                self._journal.parameters_disowned(_key((*parts, name)))
        if place.owner is None:
            return owned
        self.pool.give_back(place.owner, place.weight)
        place.weight = weight - owned
        self.pool.charge(place.owner, place.weight)
        return weight

    def _path(self, parts: Sequence[str]) -> list[_Place]:
        path = [self._root]
        for part in parts:
            below = path[-1].below.get(part)
            if below is None:
                break
            path.append(below)
        return path


def _region(path: list[_Place], parts: Sequence[str]) -> _Place:
    for place in reversed(path[: len(parts)]):
        if place.owner is not None:
            return place
    return path[0]


def _owner(place: _Place) -> Address:
    if place.owner is None:
        raise ValueError("a key on the way to a place has no owner of its own")
    return place.owner


def _key(parts: Sequence[str]) -> str:
    return "/" + "/".join(parts)


def measure(value: Value) -> tuple[int, int]:
    """Return the approximate bytes that a value takes on the wire, and its depth (0: no array or struct).

    Runs in linear time, level by level. Raises `ProtocolError` for `<nil/>`.
    """
    if type(value) in _NUMBERS:
        return _VALUE, 0
    weight, depth = 0, 0
    level: list[Value] = [value]
    while True:
        kinds = set(map(type, level))
        if kinds <= _NUMBERS:
            return weight + _VALUE * len(level), depth
        if kinds == {str}:
            return weight + _TEXT * len(level) + text_weight("".join(cast(list[str], level))), depth
        below: list[Value] = []
        for inner in level:
            weight += _own_weight(inner, below)
        if not kinds & {list, dict}:
            return weight, depth
        level, depth = below, depth + 1


def _own_weight(value: Value, below: list[Value]) -> int:
    if isinstance(value, str):
        return _TEXT + text_weight(value)
    if isinstance(value, bytes):
        return _TEXT + len(value) * 4 // 3
    if isinstance(value, list):
        below += value
        return _ARRAY
    if isinstance(value, dict):
        below += value.values()
        return _STRUCT + NAME_WEIGHT * len(value) + text_weight("".join(value))
    if value is None:
        raise ProtocolError("a value has <nil/> in it, which neither the ROS master nor roscpp can send")
    return _VALUE


def member_weight(name: str, value: Value) -> int:
    return NAME_WEIGHT + text_weight(name) + measure(value)[0]
