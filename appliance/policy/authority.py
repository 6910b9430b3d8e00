"""Read `[Authority]`: groups of topics and services that one host at a time may command.

The section only restricts: a host that holds a group still needs its rights in `[Publishers]` and `[Clients]`.
"""

import re
from collections.abc import Hashable
from dataclasses import dataclass, replace
from enum import StrEnum

from appliance.base.validation_messages import meant
from appliance.policy.groups import HostGroups
from appliance.policy.host_sets import Atom
from appliance.policy.ini_reader import Entry, SectionText, is_repeated
from appliance.policy.model import Rule
from appliance.policy.policy_findings import Findings, Place, quoted
from appliance.policy.sections import AUTHORITY
from roswire.names import is_global_name

DEFAULT_LEASE = 5.0
SHORTEST_LEASE, LONGEST_LEASE = 2.0, 3600.0
"""The bounds of a lease in seconds.

Relays report once a second which publications move, so a shorter lease could end while its holder publishes.
"""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,63}", re.ASCII)
_SECONDS = re.compile(r"([0-9]{1,5}(?:\.[0-9]{1,3})?)s", re.ASCII)
_MOST = 100


class Claim(StrEnum):
    """The right of a host to a group: take it if it is free, take it from its holder, or only ask for it."""

    TAKE = "take"
    OVERRIDE = "override"
    ASK = "ask"


_LEASE = "lease"
_OPTIONS = (*Claim, _LEASE)


@dataclass(frozen=True, slots=True)
class AuthorityGroup:
    """A group; its authority ends after `lease` seconds of silence."""

    name: str
    names: frozenset[str]
    rule: Rule
    hosts: tuple[tuple[Claim, frozenset[Atom]], ...] = ()
    lease: float = DEFAULT_LEASE

    def claim(self, atoms: frozenset[Atom]) -> Claim | None:
        claims = {claim for claim, hosts in self.hosts if not hosts.isdisjoint(atoms)}
        return next((claim for claim in (Claim.OVERRIDE, Claim.TAKE, Claim.ASK) if claim in claims), None)


def read_authority(
    section: SectionText | None, file: str, groups: HostGroups, findings: Findings
) -> dict[str, AuthorityGroup]:
    found: dict[str, AuthorityGroup] = {}
    options: list[tuple[str, str, Entry]] = []
    first_lines: dict[Hashable, int] = {}
    for entry in section.entries if section is not None else ():
        word, words = entry.key, entry.key.text.split()
        if is_repeated(" ".join(words), word, first_lines, findings):
            continue
        if len(words) == 2:
            options.append((words[0], words[1], entry))
        else:
            _define(entry, file, found, findings)
    for option, name, entry in options:
        if name in found:
            found[name] = _with_option(found[name], option, entry, groups, findings)
        else:
            guess = meant(name, found) or ": define it first, such as base = /cmd_vel"
            findings.error(entry.key, f"no group {quoted(name)} is in [Authority]{guess}")
    for group in found.values():
        if not any(claim is not Claim.ASK for claim, _hosts in group.hosts):
            text = f"only an operator can give {group.name} to a host: if a host may take it, add take {group.name} ="
            findings.warn(Place(group.rule.line), text)
    return found


def _define(entry: Entry, file: str, found: dict[str, AuthorityGroup], findings: Findings) -> None:
    word = entry.key
    if not _NAME.fullmatch(word.text) or word.text in _OPTIONS:
        text = f"{quoted(word.text)} is not the name of a group: letters, digits and _ . - after a letter"
        findings.error(word, text)
        return
    if len(found) >= _MOST:
        findings.error(word, f"more than {_MOST} groups")
        return
    names: set[str] = set()
    taken = {name: group.name for group in found.values() for name in group.names}
    for value in entry.values:
        if not is_global_name(value.text):
            text = f"{quoted(value.text)} is not a resolved name (/cmd_vel) without patterns"
            findings.error(value, text)
        elif value.text in taken:
            findings.error(value, f"{value.text} is already in the group {taken[value.text]}")
        names.add(value.text)
    if not names:
        findings.error(word, "name the topics and services of the group, such as /cmd_vel")
    found[word.text] = AuthorityGroup(
        word.text, frozenset(names), Rule(AUTHORITY, word.text, file, word.line)
    )


def _with_option(
    group: AuthorityGroup, option: str, entry: Entry, groups: HostGroups, findings: Findings
) -> AuthorityGroup:
    word = entry.key
    if option == _LEASE:
        text = " ".join(value.text for value in entry.values)
        number = _SECONDS.fullmatch(text)
        if number is None or not SHORTEST_LEASE <= float(number[1]) <= LONGEST_LEASE:
            fault = (
                f"{quoted(text)} is not a lease: give {SHORTEST_LEASE:g}s to {LONGEST_LEASE:g}s, such as 5s"
            )
            findings.error(word, fault)
            return group
        return replace(group, lease=float(number[1]))
    if option not in _OPTIONS:
        guess = meant(option, _OPTIONS) or f"; {', '.join(_OPTIONS)}"
        findings.error(word, f"unknown option {quoted(option)} of a group{guess}")
        return group
    atoms = frozenset(atom for _text, atom in groups.read(entry.values))
    return replace(group, hosts=(*group.hosts, (Claim(option), atoms)))
