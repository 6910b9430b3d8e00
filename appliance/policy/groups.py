"""Read the right side of a rule as atoms of `HostSets`: groups, addresses, networks, `host:NAME`, `door:NAME`, `*`."""

import ipaddress
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from appliance.base.validation_messages import meant
from appliance.policy.host_sets import EVERYONE, Atom, HostSets, Network, canonical_network
from appliance.policy.hours import HoursTable, RightTime, host_units
from appliance.policy.ini_reader import Entry, SectionText, Word
from appliance.policy.model import DOOR, HOST, Address, known_name
from appliance.policy.policy_findings import Findings, quote
from appliance.policy.sections import ASK

ROBOT = "robot"
_GROUP_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*+", re.ASCII)
_HOST_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,252}", re.ASCII)
_SHOWN_LIMIT = 80
_MAX_TIMES = 1000


@dataclass(slots=True)
class HostGroup:
    """A group; `used`: a rule or another group names it."""

    atom: Atom
    word: Word | None
    values: tuple[Word, ...] = ()
    used: bool = False


class HostGroups:
    """The groups of a policy; mistakes are added to the findings."""

    def __init__(
        self,
        table: HostSets,
        findings: Findings,
        hosts: Mapping[str, Address],
        robot: Collection[Address | Network],
        now: float | None = None,
    ) -> None:
        self.robot = tuple(_as_network(member) for member in robot)
        self.groups: dict[str, HostGroup] = {ROBOT: HostGroup(table.group(), None, used=True)}
        self._table = table
        self._findings = findings
        self._hosts = hosts
        self._kept: dict[str, Atom] = {}
        self._warned_loopback = False
        self._warned_hosts: set[str] = set()
        self._now = now
        self.hours = HoursTable(None, (), findings, now)
        self.times: dict[Atom, RightTime] = {}
        table.put((table.network(network) for network in self.robot), self.groups[ROBOT].atom)

    def define(self, section: SectionText | None, hours: SectionText | None = None) -> None:
        for entry in section.entries if section is not None else ():
            self._declare(entry)
        self.hours = HoursTable(hours, self.groups, self._findings, self._now)
        for group in self.groups.values():
            self._table.put((atom for _, atom in self.read(group.values)), group.atom)
        self._find_cycles()

    def add_own(self, addresses: Collection[Address]) -> None:
        """Put addresses of the robot's machine in `robot`, except those that a rule or an enrolled host has already."""
        named = self._table.networks()
        own = [network for network in map(_as_network, addresses) if network not in named]
        self.robot += tuple(dict.fromkeys(own))
        self._table.put((self._table.network(network) for network in own), self.groups[ROBOT].atom)

    def _declare(self, entry: Entry) -> None:
        word = entry.key
        first = self.groups.get(word.text)
        if word.text == ROBOT:
            text = 'the group "robot" is predefined (the machine next to the appliance): use another name'
            self._findings.error(word, text)
        elif word.text == ASK:
            text = (
                'the word "ask" is reserved for hosts that need an approval: use another name for the group'
            )
            self._findings.error(word, text)
        elif first is not None and first.word is not None:
            text = f"the group {quote(word.text)} is already defined at line {first.word.line}"
            self._findings.error(word, text)
        elif not _GROUP_NAME.fullmatch(word.text):
            text = f"{quote(word.text)} is not a group name: letters, digits and _ . - after a letter"
            self._findings.error(word, text)
        else:
            self.groups[word.text] = HostGroup(self._table.group(), word, entry.values)

    def units(self, words: Sequence[Word]) -> list[tuple[Word, ...]]:
        return host_units(words, self.groups)

    def first_time(self, words: Sequence[Word]) -> Word | None:
        """Return the first word that limits a host in time, for lines that have no times."""
        return next((unit[1] for unit in self.units(words) if len(unit) > 1), None)

    def read(self, words: Sequence[Word]) -> tuple[tuple[str, Atom], ...]:
        atoms: dict[Atom, str] = {}
        for unit in self.units(words):
            if self._findings.full:
                break
            text = " ".join(word.text for word in unit)
            atom = self._atom(unit[0]) if len(unit) == 1 else self._timed_atom(unit, text)
            if atom in atoms:
                self._findings.warn(unit[0], f"{quote(text)} is listed twice")
            elif atom is not None:
                atoms[atom] = text
        return tuple((text, atom) for atom, text in atoms.items())

    def _timed_atom(self, unit: tuple[Word, ...], text: str) -> Atom | None:
        """Return the atom of a host within its time, a group that hosts are in only then."""
        time = self.hours.time_of(unit)
        member = self._atom(unit[0]) if time is not None else None
        if time is None or member is None:
            return None
        if text not in self._kept:
            if len(self.times) == _MAX_TIMES:
                self._findings.error(unit[1], f"more than {_MAX_TIMES} hosts with a time: put them in groups")
            self._kept[text] = atom = self._table.group()
            self._table.put([member], atom)
            self.times[atom] = time
        return self._kept[text]

    def _atom(self, word: Word) -> Atom | None:
        text = word.text
        if text == "*":
            return EVERYONE
        group = self.groups.get(text)
        if group is not None:
            group.used = True
            return group.atom
        if known_name(text) is not None:
            return self._enrolled(word)
        if text not in self._kept:
            network = self._network(word)
            if network is None:
                return None
            self._kept[text] = self._table.network(network)
        return self._kept[text]

    def _network(self, word: Word) -> Network | None:
        text = word.text
        if not (text[0].isdigit() or ":" in text or "/" in text):
            wanted = (
                meant(text, self.groups)
                or "; a value is a group, an address, a network, host:NAME, door:NAME or *"
            )
            self._findings.error(word, f"no group {quote(text)} is defined{wanted}")
            return None
        try:
            network = canonical_network(ipaddress.ip_network(text))
        except ValueError:
            network = None
        if network is None or "%" in text:
            self._findings.error(word, _address_fault(text))
            return None
        if (
            network.is_loopback
            and not self._warned_loopback
            and not any(member.is_loopback for member in self.robot)
        ):
            self._warned_loopback = True
            self._findings.warn(word, f"{text} is the appliance itself {self._robot_instead()}")
        return network

    def _robot_instead(self) -> str:
        """Return the hint to write `robot`: loopback is the appliance itself."""
        if not self.robot:
            return "(unless isolation is none): write robot if you mean the nodes of its machine"
        robot = ", ".join(str(member).removesuffix("/32").removesuffix("/128") for member in self.robot)
        return f"here; the robot is {robot}: write robot if you mean it"

    def _enrolled(self, word: Word) -> Atom | None:
        name = known_name(word.text) or ""
        address = self._hosts.get(name)
        if address is not None:
            return self._table.network(_as_network(address))
        door = word.text.startswith(DOOR)
        if not _HOST_NAME.fullmatch(name.removeprefix(DOOR)):
            form = "door:NAME with the name of a door" if door else "host:NAME with the name of a certificate"
            self._findings.error(word, f"{quote(word.text)} is not {form}")
        elif name not in self._warned_hosts:
            self._warned_hosts.add(name)
            guess = meant(name, [host for host in self._hosts if host.startswith(DOOR) is door])
            text = f"no host {quote(name)} is enrolled: host:{name} matches no host until it is{guess}"
            if door:
                text = f"there is no door {quote(name.removeprefix(DOOR))}: {name} matches no host until it is added"
                text += guess
            self._findings.warn(word, text)
        return None

    def _find_cycles(self) -> None:
        done: set[str] = {ROBOT}
        for start in self.groups:
            path: list[str] = []
            on_path: set[str] = set()
            waiting: list[tuple[str, bool]] = [(start, True)]
            while waiting:
                name, entering = waiting.pop()
                if not entering:
                    on_path.discard(path.pop())
                    done.add(name)
                elif name in on_path:
                    self._note_cycle(path[path.index(name) :])
                elif name not in done:
                    path.append(name)
                    on_path.add(name)
                    waiting.append((name, False))
                    values = self.groups[name].values
                    waiting.extend((w.text, True) for w in values if w.text in self.groups)

    def _note_cycle(self, cycle: list[str]) -> None:
        word = self.groups[cycle[0]].word
        if word is not None:
            shown = cycle if len(cycle) < 8 else [*cycle[:6], "…"]
            text = f"the group contains itself: {' = '.join([*shown, cycle[0]])}"
            self._findings.error(word, text)

    def to_text(self, words: Sequence[Word]) -> str:
        parts: list[str] = []
        length = 0
        for word, *limits in self.units(words):
            part = " ".join([self._spell_out(word), *(limit.text for limit in limits)])
            if parts and length + len(part) > _SHOWN_LIMIT:
                parts.append("…")
                break
            parts.append(part)
            length += len(part) + 2
        return ", ".join(parts)

    def _spell_out(self, word: Word) -> str:
        text = word.text if len(word.text) <= _SHOWN_LIMIT else word.text[:_SHOWN_LIMIT] + "…"
        name = known_name(text)
        if name is not None:
            address = self._hosts.get(name)
            return f"{text} ({address or ('not enrolled' if text.startswith(HOST) else 'not added')})"
        if text == ROBOT:
            members = ", ".join(str(member).removesuffix("/32").removesuffix("/128") for member in self.robot)
            return f"robot ({members})" if 0 < len(members) <= 40 else text
        group = self.groups.get(text)
        if group is None:
            return "every host" if text == "*" else text
        inside = ", ".join(member.text for member in group.values[:3])
        return f"{text} ({inside})" if len(group.values) <= 2 and 0 < len(inside) <= 40 else text


def _as_network(member: Address | Network) -> Network:
    if isinstance(member, ipaddress.IPv4Network | ipaddress.IPv6Network):
        return canonical_network(member)
    return canonical_network(ipaddress.ip_network((int(member), member.max_prefixlen)))


def _address_fault(text: str) -> str:
    address, slash, _ = text.partition("/")
    if "%" in text:
        return f"{quote(text)} has a zone: write the address alone"
    try:
        ipaddress.ip_address(address)
    except ValueError:
        hint = "; an enrolled host is host:NAME, a door is door:NAME" if ":" in text else ""
        return f"{quote(text)} is not an IP address{hint}"
    if not slash:
        return f"{quote(text)} is not an IP address"
    try:
        network = ipaddress.ip_network(text, strict=False)
    except ValueError:
        return f"{quote(text)} is not a network: the part after the slash is a number of bits"
    return f"{quote(text)} has bits set beyond its prefix: did you mean {network} or {address}?"
