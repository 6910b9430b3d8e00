"""Find whether another policy takes a right from a host, by one name for each rule of both policies."""

from collections.abc import Iterator

from appliance.policy.commands import COMMANDS
from appliance.policy.keys import Key
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy

_ANY = "any_name"  # stands for the stars of a key


class LostRights:
    """The hosts that had a right under the policy `old` and do not have it under `new`."""

    def __init__(self, old: Policy, new: Policy) -> None:
        self.old, self.new = old, new
        self._names = {category: tuple(dict.fromkeys(_names(old, new, category))) for category in Category}
        self._lost: dict[Address, bool] = {}

    def took_from(self, host: Address) -> bool:
        """Whether this host lost a right."""
        if host not in self._lost:
            self._lost[host] = any(
                self.old.decide(request).allowed and not self.new.decide(request).allowed
                for category, names in self._names.items()
                for request in (Request(host, "", category, name) for name in names)
            )
        return self._lost[host]


def _names(old: Policy, new: Policy, category: Category) -> Iterator[str]:
    if category is Category.COMMAND:
        yield from COMMANDS
        return
    yield f"/{_ANY}"  # decided by the default
    for rule in (*old.rules(category), *new.rules(category)):
        if rule.key is not None:
            yield _name(rule.key)


def _name(key: Key) -> str:
    """Return a name that the key matches."""
    if key.exact:
        return key.text
    steps = "".join(f"/{text}{_ANY if star else ''}" for text, star in key.steps)
    return f"{steps}/{_ANY}" if key.subtree else steps
