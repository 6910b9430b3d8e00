"""Read `[Authority]`: groups of topics and services that one host at a time may command.

The section only restricts: a host that holds a group still needs its rights in `[Publishers]` and `[Clients]`.

Either hosts take a group (`take`, `override`, `ask`), or its one topic has a `rank`: then the highest node that moves
drives. All messages of one topic pass the same relay process, which a group of several topics cannot promise.
"""

import re
from collections.abc import Hashable
from dataclasses import dataclass, replace
from enum import StrEnum

from appliance.base.validation_messages import meant
from appliance.policy.groups import HostGroups
from appliance.policy.host_sets import Atom
from appliance.policy.ini_reader import Entry, SectionText, Word, is_repeated
from appliance.policy.model import Address, Rule
from appliance.policy.policy_findings import Findings, Place, quote
from appliance.policy.sections import AUTHORITY
from roswire.names import is_global_name

DEFAULT_TIME = 5.0
SHORTEST_TIME, LONGEST_TIME = 2.0, 3600.0
"""The bounds of `release_after`, in seconds.

Relays report once a second which publications move, so a holder that publishes could lose the group in a shorter time.
"""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,63}", re.ASCII)
_SECONDS = re.compile(r"([0-9]{1,5}(?:\.[0-9]{1,3})?)s", re.ASCII)
_MAX = 100
DEFAULT_FREE = 0.3
SHORTEST_FREE, LONGEST_FREE = 0.1, 60.0
"""The bounds of `free`, the time in seconds from a ranked driver's zero until lower ranks may move."""
_ROS_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}", re.ASCII)
_MILLISECONDS = re.compile(r"([0-9]{1,5})ms", re.ASCII)
_NODE = re.compile(r"([^/]++)(/[A-Za-z].*+)")
"""`HOST/NODE`. No name of a node begins with a digit, so no network has this form."""
_HIGHER = ">"
_MAX_RANKS = 16


class Claim(StrEnum):
    """The right of a host to a group: take it if it is free, take it from its holder, or only ask for it."""

    TAKE = "take"
    OVERRIDE = "override"
    ASK = "ask"


_RELEASE_AFTER, _RANK, _FREE = "lease", "rank", "free"
_OPTIONS = (*Claim, _RELEASE_AFTER, _RANK, _FREE)


@dataclass(frozen=True, slots=True)
class RankMember:
    """The nodes of some hosts, or their node `node` alone; `text` is as written."""

    text: str
    hosts: frozenset[Atom]
    node: str = ""


@dataclass(frozen=True, slots=True)
class AuthorityGroup:
    """A command group; its holder loses it after `release_after` seconds of silence.

    `ranks` are the members of each rank, the highest first; a group without them has holders. `free` is in seconds.
    """

    name: str
    names: frozenset[str]
    rule: Rule
    hosts: tuple[tuple[Claim, frozenset[Atom]], ...] = ()
    release_after: float = DEFAULT_TIME
    ranks: tuple[tuple[RankMember, ...], ...] = ()
    free: float = DEFAULT_FREE

    @property
    def topic(self) -> str:
        """The one name of a group with a rank."""
        return min(self.names)

    def rank(self, atoms: frozenset[Atom], node: str) -> int | None:
        """Return the rank of a host's node (0 is the highest), or None. A node counts before all nodes of its host."""
        for wanted in (node, ""):
            for rank, members in enumerate(self.ranks):
                if any(member.node == wanted and not member.hosts.isdisjoint(atoms) for member in members):
                    return rank
        return None

    def in_words(self, rank: int) -> str:
        return " ".join(member.text for member in self.ranks[rank])

    def claim(self, atoms: frozenset[Atom]) -> Claim | None:
        """Return the best claim of a host. In a group with a rank, hosts with a rank may take it, by moving."""
        if self.ranks:
            ranked = any(not member.hosts.isdisjoint(atoms) for members in self.ranks for member in members)
            return Claim.TAKE if ranked else None
        claims = {claim for claim, hosts in self.hosts if not hosts.isdisjoint(atoms)}
        return next((claim for claim in (Claim.OVERRIDE, Claim.TAKE, Claim.ASK) if claim in claims), None)

    def order(self, host: Address, atoms: frozenset[Atom], holder: Address | None) -> str:
        """Return the command that gives the group to a host with a claim, or lets it wait for another holder."""
        claim = self.claim(atoms)
        if holder is not None and claim is not Claim.OVERRIDE:
            return f"rosrv drive ask {self.name} --host {host}"
        if claim is Claim.ASK:
            return f"rosrv drive free {self.name} --to {host}"
        return f"rosrv drive assign {self.name} --host {host}"


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
            findings.error(entry.key, f"no group {quote(name)} is in [Authority]{guess}")
    ranked = {name for option, name, _entry in options if option == _RANK}
    for option, name, entry in options:
        if option == _FREE and name in found and name not in ranked:
            text = f"only a group with a rank has a time until it is free: add rank {name} = HOSTS > HOSTS"
            findings.error(entry.key, text)
    for group in found.values():
        if group.name in ranked:
            _check_ranked(group, options, findings)
        elif not any(claim is not Claim.ASK for claim, _hosts in group.hosts):
            text = f"only an operator can give {group.name} to a host: if a host may take it, add take {group.name} ="
            findings.warn(Place(group.rule.line), text)
    return found


def _define(entry: Entry, file: str, groups: dict[str, AuthorityGroup], findings: Findings) -> None:
    word = entry.key
    if not _NAME.fullmatch(word.text) or word.text in _OPTIONS:
        text = f"{quote(word.text)} is not the name of a group: letters, digits and _ . - after a letter"
        findings.error(word, text)
        return
    if len(groups) >= _MAX:
        findings.error(word, f"more than {_MAX} groups")
        return
    names: set[str] = set()
    taken = {name: group.name for group in groups.values() for name in group.names}
    for value in entry.values:
        if not is_global_name(value.text):
            text = f"{quote(value.text)}: a group lists full names such as /cmd_vel, without patterns"
            findings.error(value, text)
        elif value.text in taken:
            findings.error(value, f"{value.text} is already in the group {taken[value.text]}")
        names.add(value.text)
    if not names:
        findings.error(word, "name the topics and services of the group, such as /cmd_vel")
    groups[word.text] = AuthorityGroup(
        word.text, frozenset(names), Rule(AUTHORITY, word.text, file, word.line)
    )


def _check_ranked(group: AuthorityGroup, options: list[tuple[str, str, Entry]], findings: Findings) -> None:
    """Report what a group with a rank cannot have."""
    place = Place(group.rule.line)
    if len(group.names) > 1:
        text = f"the group {group.name} has a rank, so it has one topic: only messages of one topic pass the same relay"
        findings.error(place, f"{text} process. Make a group with a rank of each topic")
    if not _ROS_NAME.fullmatch(group.name):
        text = f"{quote(group.name)} has a rank, so its name is a part of a topic's name: a letter, then letters,"
        findings.error(place, f"{text} digits and _")
    for option, name, entry in options:
        if name == group.name and option in (*Claim, _RELEASE_AFTER):
            text = f"a group has either a rank or {option}: in {group.name}, the node drives that moves"
            findings.error(entry.key, text)


def _read_rank(entry: Entry, groups: HostGroups, findings: Findings) -> tuple[tuple[RankMember, ...], ...]:
    if time := groups.first_time(entry.values):
        findings.error(
            time, "ranks have no times: put the host with its time into [Groups], and the group here"
        )
        return ()
    ranks: list[list[RankMember]] = [[]]
    for word in entry.values:
        if word.text == _HIGHER:
            ranks.append([])
            continue
        match = _NODE.fullmatch(word.text)
        node = "" if match is None else match[2]
        if node and not is_global_name(node):
            findings.error(
                word, f"{quote(node)} is not the name of a node: write HOST/NODE, such as robot/joy_node"
            )
        host = word if match is None else Word(word.line, word.column, match[1])
        hosts = frozenset(atom for _text, atom in groups.read((host,)))
        if any(member.text == word.text for members in ranks for member in members):
            findings.error(word, f"{quote(word.text)} has two ranks")
        ranks[-1].append(RankMember(word.text, hosts, node))
    if len(ranks) < 2 or not all(ranks):
        text = f"name at least two ranks with {_HIGHER} between them, the highest first"
        findings.error(entry.key, f"{text}: rank {entry.key.text.split()[1]} = host:ocu > host:autonomy")
    if len(ranks) > _MAX_RANKS:
        findings.error(entry.key, f"more than {_MAX_RANKS} ranks")
    return tuple(map(tuple, ranks))


def _read_free(entry: Entry, findings: Findings) -> float:
    text = " ".join(value.text for value in entry.values)
    if (short := _MILLISECONDS.fullmatch(text)) is not None:
        seconds = int(short[1]) / 1000
    else:
        seconds = float(match[1]) if (match := _SECONDS.fullmatch(text)) is not None else 0.0
    if not SHORTEST_FREE <= seconds <= LONGEST_FREE:
        bounds = f"give {SHORTEST_FREE * 1000:g}ms to {LONGEST_FREE:g}s, such as 300ms"
        findings.error(entry.key, f"{quote(text)} is not a time until a group is free: {bounds}")
        return DEFAULT_FREE
    return seconds


def _with_option(
    group: AuthorityGroup, option: str, entry: Entry, groups: HostGroups, findings: Findings
) -> AuthorityGroup:
    word = entry.key
    if option == _RELEASE_AFTER:
        text = " ".join(value.text for value in entry.values)
        number = _SECONDS.fullmatch(text)
        if number is None or not SHORTEST_TIME <= float(number[1]) <= LONGEST_TIME:
            fault = (
                f"{quote(text)} is not a valid time: give {SHORTEST_TIME:g}s to {LONGEST_TIME:g}s, such as 5s"
            )
            findings.error(word, fault)
            return group
        return replace(group, release_after=float(number[1]))
    if option == _RANK:
        return replace(group, ranks=_read_rank(entry, groups, findings))
    if option == _FREE:
        return replace(group, free=_read_free(entry, findings))
    if option not in _OPTIONS:
        guess = meant(option, _OPTIONS) or f"; {', '.join(_OPTIONS)}"
        findings.error(word, f"unknown option {quote(option)} of a group{guess}")
        return group
    atoms = frozenset(atom for _text, atom in groups.read(entry.values))
    return replace(group, hosts=(*group.hosts, (Claim(option), atoms)))
