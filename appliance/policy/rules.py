"""Compile the deciding sections into rule tables, and report mistakes."""

from collections.abc import Hashable

from appliance.base.validation_messages import meant
from appliance.policy import commands
from appliance.policy.groups import HostGroups
from appliance.policy.ini_reader import Entry, SectionText, Word, is_repeated
from appliance.policy.keys import BadKeyError, Key, command_key, parse_key, ties
from appliance.policy.model import Category, Rule
from appliance.policy.policy import CompiledRule, RuleTable, place_of
from appliance.policy.policy_findings import Findings, quote
from appliance.policy.sections import ASK, ASKING, DEFAULT, PARAMETERS, Decider

MAXIMUM_INNER_STARS = 1000
"""The most keys with a star before the end, in all sections together, because they make the search branch."""


class RuleCompiler:
    """Fills one `RuleTable` per category."""

    def __init__(self, file: str, groups: HostGroups, findings: Findings) -> None:
        self.tables = {category: RuleTable() for category in Category}
        self._file = file
        self._groups = groups
        self._patterns: dict[tuple[Category, str, bool], list[tuple[Key, int]]] = {}
        self._inner_stars = 0
        self._findings = findings

    def add_section(self, decider: Decider, section: SectionText) -> None:
        first_lines: dict[Hashable, int] = {}
        for entry in section.entries:
            if self._findings.full:
                return
            split = self._category_and_name(decider, entry)
            if split is None:
                self._groups.read(entry.values)
                continue
            category, name = split
            plain, asking = self._asking(category, entry)
            words, asked = self._groups.read(plain), self._groups.read(asking)
            if category is Category.COMMAND:
                name = Word(name.line, name.column, commands.ALIASES.get(name.text, name.text))
            key_of_line = (category, name.text)
            if is_repeated(key_of_line, entry.key, first_lines, self._findings, ": put its hosts there"):
                continue
            key = self._key(category, name)
            if key is None and name.text != DEFAULT:
                continue
            if key is not None and not key.exact and not self._fits(category, key, name):
                continue
            rule = Rule(decider.name, entry.key.text, self._file, entry.key.line)
            shown = f"only {self._groups.to_text(plain)} may" if plain else "no host may"
            if asking:
                shown += f", and with an approval {self._groups.to_text(asking)}"
            atoms, asked_atoms = (frozenset(atom for _, atom in some) for some in (words, asked))
            place = place_of(rule)
            self._add(
                category,
                CompiledRule(rule, key, atoms, (*words, *asked), shown, place, entry.key, asked_atoms),
            )

    def _asking(self, category: Category, entry: Entry) -> tuple[tuple[Word, ...], tuple[Word, ...]]:
        places = [place for place, word in enumerate(entry.values) if word.text == ASK]
        if not places:
            return entry.values, ()
        plain, asking = entry.values[: places[0]], entry.values[places[0] + 1 :]
        if category not in ASKING:
            text = "ask is for [Publishers], [Clients] and the write keys of [Parameters]"
            self._findings.error(entry.values[places[0]], text)
        elif len(places) > 1:
            text = "ask is already in this line: all hosts after it need an approval"
            self._findings.error(entry.values[places[1]], text)
        elif not asking:
            self._findings.error(entry.values[places[0]], "name the hosts that need an approval after ask")
        return plain, tuple(word for word in asking if word.text != ASK)

    def _fits(self, category: Category, key: Key, name: Word) -> bool:
        self._inner_stars += key.inner_star
        if self._inner_stars > MAXIMUM_INNER_STARS:
            text = f"more than {MAXIMUM_INNER_STARS} keys have a star before the end, such as /*/state: use fewer"
            self._findings.error(name, text)
            return False
        alike = self._patterns.setdefault((category, key.literal, key.subtree), [])
        return not ties(key, name, alike, self._findings)

    def _add(self, category: Category, rule: CompiledRule) -> None:
        table = self.tables[category]
        table.rules.append(rule)
        if rule.key is None:
            table.default = rule
        else:
            table.tree.add(rule.key, rule)

    def _category_and_name(self, decider: Decider, entry: Entry) -> tuple[Category, Word] | None:
        if len(decider.categories) == 1:
            return decider.categories[0], entry.key
        verb, _, name = entry.key.text.partition(" ")
        category = next((category for category in decider.categories if category.value == verb), None)
        if category is None or not name:
            text = "a key here is read or write and a name, such as read /ns/** or write default"
            self._findings.error(entry.key, f"{quote(entry.key.text)}: {text}")
            return None
        return category, Word(entry.key.line, entry.key.column + len(verb) + 1, name)

    def _key(self, category: Category, name: Word) -> Key | None:
        if name.text == DEFAULT:
            return None
        if category is Category.COMMAND:
            return self._command(name)
        try:
            return parse_key(name.text, parameter=category in PARAMETERS)
        except BadKeyError as fault:
            if meant(name.text, [DEFAULT]) and not name.text.startswith("/"):
                self._findings.error(name, f"{quote(name.text)}: did you mean default?")
            else:
                self._findings.error(name, f"{quote(name.text)}: {fault}")
            return None

    def _command(self, name: Word) -> Key | None:
        elsewhere = commands.DECIDED_ELSEWHERE.get(name.text)
        if name.text in commands.COMMANDS:
            return command_key(name.text)
        if elsewhere is not None:
            self._findings.error(name, f"can never match: {name.text} is decided by {elsewhere}, not here")
        elif "*" in name.text:
            self._findings.error(
                name, f"{quote(name.text)}: commands have no patterns; default matches all other commands"
            )
        else:
            guess = meant(name.text, [*commands.COMMANDS, *commands.DECIDED_ELSEWHERE, DEFAULT])
            self._findings.error(name, f"unknown command {quote(name.text)}{guess}")
        return None
