"""Read INI text, with the line and column of every word, which configparser does not report.

There are no continuation lines, no interpolation and no quotes; comments go from `#` or `;` to the end of the line.
"""

import re
from collections.abc import Hashable, MutableMapping
from dataclasses import dataclass, field

from appliance.policy.policy_findings import Findings, Place, quote

MAXIMUM_CHARACTERS = 2 * 1024 * 1024
"""The most characters of a policy; one with 10,000 rules has about 600,000."""

_WORD = re.compile(r"[^\s,]++", re.ASCII)
_COMMENT = re.compile(r"[#;]")
_NOT_IN_KEYS = re.compile(r"[#;=]")
_FOREIGN = re.compile(r"[^\t\x20-\x7e]")


@dataclass(frozen=True, slots=True)
class Word(Place):
    text: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """An entry `key = value value …`; blanks or commas separate words."""

    key: Word
    values: tuple[Word, ...]


@dataclass(slots=True)
class SectionText:
    """One `[Name]` and its entries."""

    name: Word
    entries: list[Entry] = field(default_factory=list)

    def is_named(self, name: str) -> bool:
        """Return whether it is this section. Names of sections ignore case."""
        return self.name.text.casefold() == name.casefold()


def is_key(text: str) -> bool:
    """Return whether a line can have this text as its key; parameters may have names that none can."""
    return _NOT_IN_KEYS.search(text) is None


def is_repeated(
    key: Hashable,
    word: Word,
    first_lines: MutableMapping[Hashable, int],
    findings: Findings,
    remedy: str = "",
) -> bool:
    """Return whether an earlier line of the section has this key, which is an error."""
    first = first_lines.setdefault(key, word.line)
    if first != word.line:
        findings.error(word, f"the key {quote(word.text)} is already defined at line {first}{remedy}")
    return first != word.line


def read(text: str, findings: Findings) -> list[SectionText]:
    """Return the sections; skip unreadable lines, and report them in `findings`."""
    if len(text) > MAXIMUM_CHARACTERS:
        findings.error(Place(), f"the file has {len(text)} characters; the limit is {MAXIMUM_CHARACTERS}")
        return []
    if (at := text.find("\0")) >= 0:
        place = Place(text.count("\n", 0, at) + 1, at - text.rfind("\n", 0, at))
        findings.error(place, f"unexpected character {quote(text[at])}: this is not a text file")
        return []
    sections: list[SectionText] = []
    for number, raw in enumerate(text.removeprefix("\ufeff").split("\n"), start=1):
        line = _without_comment(raw.removesuffix("\r"))
        if not line.strip():
            continue
        if foreign := _FOREIGN.search(line):
            shown = quote(foreign.group())
            place = Place(number, foreign.start() + 1)
            findings.error(place, f"unexpected character {shown}: rules are plain ASCII")
        elif line.lstrip().startswith("["):
            _begin_section(line, number, sections, findings)
        else:
            _add_entry(line, number, sections, findings)
        if findings.full:
            break
    return sections


def _without_comment(line: str) -> str:
    comment = _COMMENT.search(line)
    return line[: comment.start()] if comment else line


def _begin_section(line: str, number: int, sections: list[SectionText], findings: Findings) -> None:
    start = line.index("[")
    inside, bracket, rest = line[start + 1 :].partition("]")
    name = inside.strip()
    word = Word(number, start + 1, name)
    if not bracket:
        findings.error(word, f'the section {quote(line.strip())} is not closed: add "]"')
    elif rest.strip():
        column = start + 1 + len(inside) + 1 + len(rest) - len(rest.lstrip()) + 1
        findings.error(Place(number, column), f"unexpected text after the section: {quote(rest.strip())}")
    # Keep the section in spite of the error, so that its entries are not added to the section before.
    sections.append(SectionText(word))


def _add_entry(line: str, number: int, sections: list[SectionText], findings: Findings) -> None:
    left, equals, right = line.partition("=")
    key = Word(number, len(left) - len(left.lstrip()) + 1, " ".join(left.split()))
    if not equals:
        findings.error(key, f"expected key = value, found {quote(key.text)}")
    elif not key.text:
        findings.error(key, 'expected a key before "="')
    elif not sections:
        findings.error(key, f"{quote(key.text)} is before the first section: add one, such as [Groups]")
    else:
        words = _WORD.finditer(right)
        values = tuple(Word(number, len(left) + 1 + m.start() + 1, m.group()) for m in words)
        sections[-1].entries.append(Entry(key, values))
