"""Mirror the ROS master's parameter tree, so that it survives the ROS master's death."""

import contextlib
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import cast

from appliance.master.parameter_charges import (
    APPLIANCE,
    NAME_WEIGHT,
    LimitReachedError,
    ParameterCharges,
    measure,
    member_weight,
)
from appliance.policy.model import Address
from appliance.quotas.pool import Pool
from appliance.rpc.fair_queue import text_weight
from roswire.errors import ProtocolError
from roswire.parameter_tree import Tree, parts_of, standing_at
from roswire.xmlrpc import Value


class ParameterMirror:
    """A copy of the ROS master's parameter tree, changed only after the ROS master has accepted the change.

    `weight` is the approximate size of the whole tree in an answer to `getParam("/")`. It and the depth are limited,
    because otherwise the ROS master could send its tree to no node.

    `note(key, value)` is called for each change of one parameter (None: it was deleted); a change of the whole tree
    sets `unnoted`, until its owner has stored the tree.
    """

    def __init__(
        self,
        tree: Tree,
        changed: Callable[[], None],
        charges: ParameterCharges,
        *,
        depth_limit: int = 100,
        note: Callable[[str, Value], None],
        together: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
        since: Iterable[tuple[str, Value]] = (),
    ) -> None:
        self.tree = tree
        self.charges = charges
        self.weight = 0
        self.unnoted = False
        self._changed = changed
        self._note = note
        self.together = together
        self._depth_limit = depth_limit
        for key, value in since:
            if value is None:
                self._take_out(key)
            else:
                self._put_in(key, value)
        self._recount(final=False)

    @property
    def bytes_limit(self) -> int:
        return self.charges.pool.bounds.whole

    def check(self, key: str, depth: int) -> None:
        """Raise `ProtocolError` if a value with this depth would be too deep at this key."""
        if len(parts_of(key)) + depth > self._depth_limit:
            raise ProtocolError(f"parameter {key[:80]} would nest deeper than {self._depth_limit} levels")

    def reserve(self, key: str, weight: int, host: Address) -> "Reservation":
        """Reserve room for a value that a host is about to set. Raises `LimitReachedError`.

        A value that is not larger than the present one always has room, charged to this host within its quota,
        otherwise to the previous owner. So a host can always correct a parameter, and two hosts together cannot
        exceed their quotas.
        """
        pool = self.charges.pool
        parts, before = self._place_of(key)
        held = self.charges.weights_by_owner(parts, before)
        after = _with_namespaces(key, len(parts), weight)
        growth = max(0, after - held.get(host, 0))
        refusal = pool.take(host, growth) if growth else ""
        if not refusal:
            return Reservation(pool, host, growth, weight)
        former, most = max(held.items(), key=lambda item: item[1])
        if after > most:
            raise LimitReachedError(f"parameter {key[:80]} is not set: {refusal}")
        return Reservation(pool, former, 0, weight)

    def replace(self, tree: Tree) -> None:
        self.tree = tree
        self._recount(final=True)
        self.unnoted = True
        self._changed()

    def set(self, key: str, value: Value, reserved: "Reservation") -> None:
        """Set `key`; a dictionary replaces the namespace. The mirror keeps the object."""
        reserved.release()
        parts, before = self._place_of(key)
        self._put_in(key, value)
        after = _with_namespaces(key, len(parts), reserved.weight)
        self.charges.replace(parts, before, after, reserved.owner)
        self.weight += after - before
        if parts:
            self._note(key, value)
        else:
            self.unnoted = True
        self._changed()

    def delete(self, key: str) -> None:
        parts = parts_of(key)
        there, in_the_way = standing_at(self.tree, key)
        if not parts or there is None or in_the_way is not None:
            return
        before = member_weight(parts[-1], there)
        self._take_out(key)
        self.charges.replace(parts, before, 0, APPLIANCE)
        self.weight -= before
        self._note(key, None)
        self._changed()

    def _recount(self, *, final: bool) -> None:
        self.weight = measure(self.tree)[0]
        self.charges.recount(self.tree, final=final)

    def _place_of(self, key: str) -> tuple[tuple[str, ...], int]:
        parts = parts_of(key)
        node: Value = self.tree
        for depth, part in enumerate(parts, 1):
            assert isinstance(node, dict)  # noqa: S101 - true for the root and checked below; narrows for mypy
            if part not in node:
                return parts[:depth], 0
            if depth == len(parts) or not isinstance(node[part], dict):
                return parts[:depth], member_weight(part, node[part])
            node = node[part]
        return (), self.weight

    def _put_in(self, key: str, value: Value) -> None:
        parts = parts_of(key)
        if not parts:
            self.tree = cast(Tree, value)
            return
        node = self.tree
        for part in parts[:-1]:
            below = node.get(part)
            if not isinstance(below, dict):
                node[part] = below = {}
            node = below
        node[parts[-1]] = value

    def _take_out(self, key: str) -> None:
        above, _, name = key.rpartition("/")
        node, _ = standing_at(self.tree, above or "/")
        if isinstance(node, dict):
            node.pop(name, None)


class Reservation:
    """Room for a value until the ROS master accepts or rejects it. `owner` is charged."""

    __slots__ = ("_amount", "_pool", "owner", "weight")

    def __init__(self, pool: Pool[Address], owner: Address, amount: int, weight: int) -> None:
        self._pool = pool
        self._amount = amount
        self.owner = owner
        self.weight = weight

    def release(self) -> None:
        if self._amount:
            self._pool.give_back(self.owner, self._amount)
            self._amount = 0


def _with_namespaces(key: str, first: int, weight: int) -> int:
    if not first:
        return weight
    *namespaces, name = parts_of(key)[first - 1 :]
    whole = NAME_WEIGHT + text_weight(name) + weight
    return whole + sum(member_weight(part, {}) for part in namespaces) if namespaces else whole
