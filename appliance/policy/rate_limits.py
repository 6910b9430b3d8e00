"""Read `[Limits]`: the number of messages and bytes that may pass in a second (docs/reference/policy-file.md).

If several clauses of the most specific key match a host, the strictest counts. A limit neither allows nor denies.
"""

import re
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from appliance.base.validation_messages import meant
from appliance.policy.groups import HostGroups
from appliance.policy.host_sets import Atom
from appliance.policy.ini_reader import Entry, SectionText, Word, is_repeated
from appliance.policy.keys import BadKeyError, Key, KeyTree, parse_key, ties
from appliance.policy.model import Rule
from appliance.policy.policy_findings import Findings, Place, quote
from appliance.policy.sections import DEFAULT, LIMITS


class LimitScope(StrEnum):
    """The scope of a limit, which counts all messages in it together."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    TOPIC = "topic"


@dataclass(frozen=True, slots=True)
class Rate:
    """A limit per second; 0 means unlimited."""

    messages: float = 0.0
    bytes: float = 0.0

    def __bool__(self) -> bool:
        return self.messages > 0 or self.bytes > 0

    def __str__(self) -> str:
        parts = [f"{self.messages:g} Hz"] if self.messages else []
        if self.bytes:
            unit = next(unit for unit in reversed(_BYTES) if self.bytes >= _BYTES[unit] or unit == "B/s")
            parts.append(f"{self.bytes / _BYTES[unit]:g} {unit}")
        return ", ".join(parts) or "no limit"

    def strictest(self, other: "Rate") -> "Rate":
        return Rate(_lower(self.messages, other.messages), _lower(self.bytes, other.bytes))


NO_LIMIT = Rate()
_PARTS = frozenset(part.value for part in LimitScope)
_BYTES = {"B/s": 1.0, "kB/s": 1e3, "MB/s": 1e6, "GB/s": 1e9}
_UNITS = {"Hz": 1.0, **_BYTES}
_FOLDED = {unit.casefold(): unit for unit in _UNITS}
_NUMBER = re.compile(r"([0-9]++(?:\.[0-9]++)?)([A-Za-z/]*+)", re.ASCII)
_LEAST, _MAX = 1e-3, 1e12
_LINES = 1000


@dataclass(frozen=True, slots=True)
class Clause:
    """A limit for nodes on hosts with one of `atoms` (None: on all hosts)."""

    part: LimitScope
    atoms: frozenset[Atom] | None
    rate: Rate


@dataclass(frozen=True, slots=True)
class LimitRule:
    """A line of `[Limits]`; `key` is None for `default`."""

    rule: Rule
    key: Key | None
    clauses: tuple[Clause, ...]

    def rate(self, part: LimitScope, atoms: frozenset[Atom]) -> Rate:
        rate = NO_LIMIT
        for clause in self.clauses:
            if clause.part is part and (clause.atoms is None or not clause.atoms.isdisjoint(atoms)):
                rate = rate.strictest(clause.rate)
        return rate


class LimitTable:
    """The lines of `[Limits]`."""

    def __init__(self) -> None:
        self.rules: list[LimitRule] = []
        self._tree: KeyTree[LimitRule] = KeyTree()
        self._default: LimitRule | None = None

    def add(self, rule: LimitRule) -> None:
        self.rules.append(rule)
        if rule.key is None:
            self._default = rule
        else:
            self._tree.add(rule.key, rule)

    def find(self, topic: str) -> LimitRule | None:
        return self._tree.find(topic) or self._default


def read_limits(section: SectionText | None, file: str, groups: HostGroups, findings: Findings) -> LimitTable:
    table = LimitTable()
    first_lines: dict[Hashable, int] = {}
    patterns: list[tuple[Key, int]] = []
    for entry in section.entries if section is not None else ():
        if findings.full:
            break
        word = entry.key
        if len(first_lines) >= _LINES:
            findings.error(word, f"more than {_LINES} limits: use patterns (/camera/**)")
            break
        if is_repeated(word.text, word, first_lines, findings, ": put its limits there"):
            continue
        key = _key(word, patterns, findings)
        clauses = tuple(_clauses(entry, groups, findings))
        if clauses and (key is not None or word.text == DEFAULT):
            table.add(LimitRule(Rule(LIMITS, word.text, file, word.line), key, clauses))
    _warn_of_shadowed_default(table, first_lines, findings)
    return table


def _key(word: Word, patterns: list[tuple[Key, int]], findings: Findings) -> Key | None:
    if word.text == DEFAULT:
        return None
    try:
        key = parse_key(word.text, parameter=False)
    except BadKeyError as fault:
        findings.error(word, f"{quote(word.text)}: {fault}")
        return None
    return None if not key.exact and ties(key, word, patterns, findings) else key


def _clauses(entry: Entry, groups: HostGroups, findings: Findings) -> Iterator[Clause]:
    parts: list[tuple[Word, list[Word]]] = []
    for word in entry.values:
        if word.text in _PARTS:
            parts.append((word, []))
        elif parts:
            parts[-1][1].append(word)
        else:
            guess = meant(word.text, _PARTS) or ", such as publisher 30 Hz 10 MB/s"
            text = f"a limit begins with publisher, subscriber or topic, not {quote(word.text)}{guess}"
            findings.error(word, text)
            return
    if not parts:
        findings.error(entry.key, "add whose limit it is: publisher 30 Hz 10 MB/s")
    for word, words in parts:
        clause = _clause(word, words, groups, findings)
        if clause is not None:
            yield clause


def _clause(part: Word, words: list[Word], groups: HostGroups, findings: Findings) -> Clause | None:
    hosts = []
    while words and not _NUMBER.fullmatch(words[0].text):
        hosts.append(words.pop(0))
    rate = _rate(part, words, findings)
    if rate is None:
        return None
    if hosts and part.text == LimitScope.TOPIC:
        text = "topic limits all publishers together: name no hosts, or limit each publisher there"
        findings.error(hosts[0], text)
        return None
    if time := groups.first_time(hosts):
        findings.error(time, "limits have no times: they hold at any hour")
        return None
    atoms = frozenset(atom for _, atom in groups.read(hosts)) if hosts else None
    return Clause(LimitScope(part.text), atoms, rate)


def _rate(part: Word, words: list[Word], findings: Findings) -> Rate | None:
    found: dict[str, float] = {}
    words = list(words)
    while words:
        word = words.pop(0)
        number = _NUMBER.fullmatch(word.text)
        if number is None:
            findings.error(word, f"{quote(word.text)}: put hosts before the numbers")
            return None
        unit = number[2] or (words.pop(0).text if words else "")
        fault = _fault(float(number[1]), _FOLDED.get(unit.casefold()), unit, found)
        if fault:
            findings.error(word, fault)
            return None
        kind = "Hz" if unit.casefold() == "hz" else "B/s"
        found[kind] = float(number[1]) * _UNITS[_FOLDED[unit.casefold()]]
    if not found:
        text = f"how much may pass for each {part.text}? as {part.text} 30 Hz 10 MB/s"
        findings.error(part, text)
        return None
    return Rate(found.get("Hz", 0.0), found.get("B/s", 0.0))


def _fault(number: float, known: str | None, unit: str, found: dict[str, float]) -> str:
    if known is None:
        guess = meant(unit, list(_UNITS)) if unit else ""
        return (
            f"{number:g} {unit}".strip()
            + f" has no unit of a limit{guess or ': Hz, B/s, kB/s, MB/s or GB/s'}"
        )
    if not _LEAST <= number * _UNITS[known] <= _MAX:
        return f"{number:g} {known} cannot be enforced; to forbid sending, leave the host out of [Publishers]"
    if ("Hz" if known == "Hz" else "B/s") in found:
        return f"{number:g} {known}: this is already limited; give one number of messages and one of bytes"
    return ""


def _lower(one: float, other: float) -> float:
    return min(one, other) if one and other else one or other


def _warn_of_shadowed_default(table: LimitTable, lines: Mapping[Hashable, int], findings: Findings) -> None:
    everything = next((rule for rule in table.rules if rule.key is not None and rule.key.text == "/**"), None)
    if everything is not None and DEFAULT in lines:
        text = f"never limits: /** at line {everything.rule.line} matches every name before it"
        findings.warn(Place(lines[DEFAULT]), text)
