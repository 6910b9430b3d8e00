"""Mirrors of the parameter tree, as tests make them."""

from collections.abc import Callable, Iterable
from typing import Any

from appliance.master.parameter_charges import ParameterCharges, measure
from appliance.master.parameter_mirror import ParameterMirror
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, Standing
from roswire.parameter_tree import Tree
from roswire.xmlrpc import Value


class Owners:
    """The journal of who set what: keys and hosts."""

    def __init__(self, kept: Iterable[tuple[str, str]] = ()) -> None:
        self.kept = dict(kept)

    def parameter_owned(self, key: str, host: str) -> None:
        """As `StateStore`."""
        self.kept[key] = host

    def parameters_disowned(self, key: str) -> None:
        """As `StateStore`."""
        below = f"{key.rstrip('/')}/"
        self.kept = {one: host for one, host in self.kept.items() if one != key and not one.startswith(below)}


def registered(_host: Address) -> Standing:
    """Every host has nodes."""
    return Standing.REGISTERED


def mirror(
    tree: Tree | None = None,
    *,
    whole: int = 64 << 20,
    bounds: Bounds | None = None,
    standing: Callable[[Address], Standing] = registered,
    owners: Owners | None = None,
    note: Callable[[str, Value], None] = lambda _key, _value: None,
    **more: Any,
) -> ParameterMirror:
    """A mirror of this tree; one host may have all of it (`whole`), or what `bounds` say."""
    pool = Pool("bytes of parameters", bounds or Bounds(whole, whole, 0, 0), standing)
    owners = owners or Owners()
    charges = ParameterCharges(pool, owners, list(owners.kept.items()))
    return ParameterMirror(tree or {}, lambda: None, charges, note=note, **more)


def put(there: ParameterMirror, key: str, value: Value, host: Address) -> None:
    """A host sets a parameter. Raises `LimitReachedError`."""
    there.set(key, value, there.reserve(key, measure(value)[0], host))
