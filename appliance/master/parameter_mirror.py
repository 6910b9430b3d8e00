"""The mirror of ROSMaster's parameter tree, which survives its death, and room for what is about to be set.

The mirror changes exactly as ROSMaster's tree does, and only after ROSMaster took the change.
"""

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
from appliance.rpc.bulk import text_weight
from roswire.errors import ProtocolError
from roswire.parameter_tree import Tree, parts_of, standing_at
from roswire.xmlrpc import Value


class ParameterMirror:
    """A copy of ROSMaster's parameter tree, and who is charged for it; `changed()` hears of every change.

    `weight` is about the bytes of the whole tree in an answer to `getParam("/")`. It and the depth are bounded: a
    tree that ROSMaster could not tell any more would break it for everybody, and could not be read after a restart.
    `note(key, value)` hears of each change of one parameter (None: it is gone); `since` are those after `tree`. What it
    hears inside `together()` is kept at the end of that.
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
        """What all parameters together may weigh."""
        return self.charges.pool.bounds.whole

    def check(self, key: str, depth: int) -> None:
        """Raise `ProtocolError` for a value that would be too deep."""
        if len(parts_of(key)) + depth > self._depth_limit:
            raise ProtocolError(f"parameter {key[:80]} would nest deeper than {self._depth_limit} levels")

    def reserve(self, key: str, weight: int, host: Address) -> "Reserved":
        """Keep room for a value that a host is about to set. Raises `LimitReachedError` when there is none for it.

        What takes no more than one host had there takes the place of that: it is charged to this host if it has room,
        and stays the other's if not. So whoever may write can always correct a parameter, and two hosts together get
        no more than their shares.
        """
        pool = self.charges.pool
        parts, before = self._place_of(key)
        held = self.charges.held(parts, before)
        after = _with_namespaces(key, len(parts), weight)
        growth = max(0, after - held.get(host, 0))
        refusal = pool.take(host, growth) if growth else ""
        if not refusal:
            return Reserved(pool, host, growth, weight)
        former, most = max(held.items(), key=lambda item: item[1])
        if after > most:
            raise LimitReachedError(f"parameter {key[:80]} is not set: {refusal}")
        return Reserved(pool, former, 0, weight)

    def replace(self, tree: Tree) -> None:
        """Take the tree that ROSMaster has."""
        self.tree = tree
        self._recount(final=True)
        self._changed()

    def set(self, key: str, value: Value, reserved: "Reserved") -> None:
        """`key` (canonical) has this value, which is the mirror's from now on; a dictionary replaces the namespace."""
        reserved.release()
        parts, before = self._place_of(key)
        self._put_in(key, value)
        after = _with_namespaces(key, len(parts), reserved.weight)
        self.charges.replaced(parts, before, after, reserved.owner)
        self.weight += after - before
        if parts:
            self._note(key, value)
        self._changed()

    def delete(self, key: str) -> None:
        """`key` (canonical) is gone."""
        parts = parts_of(key)
        there, in_the_way = standing_at(self.tree, key)
        if not parts or there is None or in_the_way is not None:
            return
        before = member_weight(parts[-1], there)
        self._take_out(key)
        self.charges.replaced(parts, before, 0, APPLIANCE)
        self.weight -= before
        self._note(key, None)
        self._changed()

    def _recount(self, *, final: bool) -> None:
        self.weight = measure(self.tree)[0]
        self.charges.recount(self.tree, final=final)

    def _place_of(self, key: str) -> tuple[tuple[str, ...], int]:
        """The topmost key that is new, or another, when `key` is set; and what is there now, in bytes."""
        parts = parts_of(key)
        node: Value = self.tree
        for depth, part in enumerate(parts, 1):
            assert isinstance(node, dict)  # noqa: S101 - the root is one, and no other goes on; narrows for mypy
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


class Reserved:
    """Room for a value of this weight until ROSMaster has it or refuses it; `owner` is charged for it."""

    __slots__ = ("_amount", "_pool", "owner", "weight")

    def __init__(self, pool: Pool[Address], owner: Address, amount: int, weight: int) -> None:
        self._pool = pool
        self._amount = amount
        self.owner = owner
        self.weight = weight

    def release(self) -> None:
        """It is set, and charged as what it is; or it could not be."""
        if self._amount:
            self._pool.give_back(self.owner, self._amount)
            self._amount = 0


def _with_namespaces(key: str, first: int, weight: int) -> int:
    """What a value of this weight takes with its name and those of its key from the `first` on, which are new."""
    if not first:
        return weight
    *namespaces, name = parts_of(key)[first - 1 :]
    whole = NAME_WEIGHT + text_weight(name) + weight
    return whole + sum(member_weight(part, {}) for part in namespaces) if namespaces else whole
