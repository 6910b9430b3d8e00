from collections.abc import Callable, Iterable
from typing import Any

from appliance.master.parameter_charges import ParameterCharges, measure
from appliance.master.parameter_mirror import ParameterMirror
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from roswire.parameter_tree import Tree
from roswire.xmlrpc import Value


class Owners:
    def __init__(self, kept: Iterable[tuple[str, str]] = ()) -> None:
        self.kept = dict(kept)

    def parameter_owned(self, key: str, host: str) -> None:
        self.kept[key] = host

    def parameters_disowned(self, key: str) -> None:
        below = f"{key.rstrip('/')}/"
        self.kept = {one: host for one, host in self.kept.items() if one != key and not one.startswith(below)}


def registered(_host: Address) -> QuotaClass:
    return QuotaClass.REGISTERED


def mirror(
    tree: Tree | None = None,
    *,
    whole: int = 64 << 20,
    bounds: Bounds | None = None,
    quota_class: Callable[[Address], QuotaClass] = registered,
    owners: Owners | None = None,
    note: Callable[[str, Value], None] = lambda _key, _value: None,
    **more: Any,
) -> ParameterMirror:
    pool = Pool("bytes of parameters", bounds or Bounds(whole, whole, 0, 0), quota_class)
    owners = owners or Owners()
    charges = ParameterCharges(pool, owners, list(owners.kept.items()))
    return ParameterMirror(tree or {}, lambda: None, charges, note=note, **more)


def put(there: ParameterMirror, key: str, value: Value, host: Address) -> None:
    there.set(key, value, there.reserve(key, measure(value)[0], host))
