"""Find the rights that a new policy takes from a host, by deciding sample names for each rule."""

from collections.abc import Iterator

from appliance.policy.commands import COMMANDS
from appliance.policy.judgement import PolicyContext
from appliance.policy.keys import Key
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy

_ANY = "any_name"  # stands for the stars of a key


class LostRights:
    """Compares two policies, without their blocks, holders and approvals."""

    def __init__(self, old: Policy, new: Policy) -> None:
        self.old, self.new = old, new
        self._names = {category: tuple(dict.fromkeys(_names(old, new, category))) for category in Category}
        self._before, self._after = map(PolicyContext().complete, (old, new))
        self._lost: dict[tuple[str, str], bool] = {}  # by the networks that both policies name

    def took_from(self, host: Address) -> bool:
        networks = self.old.alike(host), self.new.alike(host)
        if networks not in self._lost:
            self._lost[networks] = any(
                self._before.decide(request).allowed and not self._after.decide(request).allowed
                for category, names in self._names.items()
                for request in (Request(host, "", category, name) for name in names)
            )
        return self._lost[networks]


def _names(old: Policy, new: Policy, category: Category) -> Iterator[str]:
    if category is Category.COMMAND:
        yield from COMMANDS
        return
    yield from (f"/{_ANY}", f"/{_ANY}/{_ANY}", f"/{_ANY}/{_ANY}/{_ANY}")  # mostly decided by the default
    yield from (name for policy in (old, new) for group in policy.authority.values() for name in group.names)
    for rule in (*old.rules(category), *new.rules(category)):
        if rule.key is not None:
            yield from _matching(rule.key)


def _matching(key: Key) -> Iterator[str]:
    if key.exact:
        yield key.text
        return
    for word in (_ANY, "") if all(text for text, _star in key.steps) else (_ANY,):
        steps = "".join(f"/{text}{word if star else ''}" for text, star in key.steps)
        yield from (steps, f"{steps}/{_ANY}", f"{steps}/{_ANY}/{_ANY}") if key.subtree else (steps,)
