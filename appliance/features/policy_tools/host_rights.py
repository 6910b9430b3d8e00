"""List the rights of one host: the rules that grant it something. No I/O."""

from collections.abc import Iterator
from typing import NamedTuple

from appliance.policy.authority import AuthorityGroup, Claim
from appliance.policy.host_sets import Atom
from appliance.policy.model import Address, Rule
from appliance.policy.policy import Policy
from appliance.policy.sections import DECIDERS

_CLAIMS = {
    Claim.TAKE: "may take it while it is free",
    Claim.OVERRIDE: "may also take it from its holder",
    Claim.ASK: "may only ask for it: an operator assigns it",
}
APPROVAL = "needs an approval each time (rosrv approve)"


class HostRight(NamedTuple):
    """A rule that grants a host something, or a missing section, which grants all hosts everything."""

    section: str
    rule: Rule | None
    asks: bool
    """Whether each request needs an approval."""
    text: str


class GroupPart(NamedTuple):
    """The part of a host in a command group of `[Authority]`: its ranks (1 is the highest), its claim, or nothing."""

    group: str
    names: list[str]
    ranks: list[tuple[int, str]]
    """Each rank with its member as written: the host, or one of its nodes."""
    of: int
    """The number of ranks of the group; 0 for a group with holders."""
    claim: Claim | None

    @property
    def text(self) -> str:
        about = f"[Authority] {self.group} ({' '.join(self.names)})"
        if self.ranks:
            places = ", ".join(f"rank {number} of {self.of} as {member}" for number, member in self.ranks)
            return f"{about}: {places}; it drives while it moves and no higher rank does"
        if self.claim is None:
            return f"{about}: no part in it, so its messages and calls of these names are denied"
        return f"{about}: {_CLAIMS[self.claim]}"


def parts_of_host(policy: Policy, host: Address) -> Iterator[GroupPart]:
    """Yield the part of the host in each command group, in the order of the policy."""
    atoms = policy.atoms_of(host)
    for group in policy.authority.values():
        yield _part(group, atoms)


def _part(group: AuthorityGroup, atoms: frozenset[Atom]) -> GroupPart:
    ranks = [
        (number, member.text)
        for number, members in enumerate(group.ranks, 1)
        for member in members
        if not member.hosts.isdisjoint(atoms)
    ]
    claim = None if group.ranks else group.claim(atoms)
    return GroupPart(group.name, sorted(group.names), ranks, len(group.ranks), claim)


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
