"""List the rights of one host: the rules that grant it something. No I/O."""

from collections.abc import Iterator
from typing import NamedTuple

from appliance.policy.model import Address, Rule
from appliance.policy.policy import Policy
from appliance.policy.sections import DECIDERS

APPROVAL = "needs an approval each time (rosrv approve)"


class HostRight(NamedTuple):
    """A rule that grants a host something, or a missing section, which grants all hosts everything."""

    section: str
    rule: Rule | None
    asks: bool
    """Whether each request needs an approval."""
    text: str


def rights_of_host(policy: Policy, host: Address) -> Iterator[HostRight]:
    """Yield the rules in the order of the sections. Only the most specific key of a name decides on it."""
    atoms = policy.atoms_of(host)
    for decider in DECIDERS:
        if decider.extension and decider.categories[0] not in policy.present:
            text = f"[{decider.name}]: everything, because there is no such section"
            yield HostRight(decider.name, None, asks=False, text=text)
        for category in decider.categories:
            for rule in policy.rules(category):
                if rule.grants(atoms):
                    yield HostRight(decider.name, rule.rule, asks=False, text=rule.place)
                elif rule.asks(atoms):
                    yield HostRight(decider.name, rule.rule, asks=True, text=f"{rule.place}: {APPROVAL}")
