"""Read INI text, with the line and column of every word, which configparser does not report.

There are no continuation lines, no interpolation and no quotes; comments go from `#` or `;` to the end of the line.
"""

import re
from dataclasses import dataclass, field

from appliance.policy.policy_findings import Findings, quoted

MAXIMUM_CHARACTERS = 2 * 1024 * 1024
"""The most characters of a policy; one with 10,000 rules has about 600,000."""

_WORD = re.compile(r"[^\s,]++", re.ASCII)
_COMMENT = re.compile(r"[#;]")
_FOREIGN = re.compile(r"[^\t\x20-\x7e]")


@dataclass(frozen=True, slots=True)
class Word:
    """A word of the text; `line` and `column` count from 1."""

    text: str
    line: int
    column: int


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


def read(text: str, findings: Findings) -> list[SectionText]:
    """Return the sections; skip unreadable lines, and report them in `findings`."""
    if len(text) > MAXIMUM_CHARACTERS:
        findings.error(1, 1, f"the file has {len(text)} characters; the limit is {MAXIMUM_CHARACTERS}")
        return []
    sections: list[SectionText] = []
    for number, raw in enumerate(text.removeprefix("\ufeff").split("\n"), start=1):
        line = _without_comment(raw.removesuffix("\r"))
        if not line.strip():
            continue
        if foreign := _FOREIGN.search(line):
            shown = quoted(foreign.group())
            findings.error(
                number, foreign.start() + 1, f"unexpected character {shown}: rules are plain ASCII"
            )
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
    if not bracket:
        findings.error(number, start + 1, f'the section {quoted(line.strip())} is not closed: add "]"')
    elif rest.strip():
        column = start + 1 + len(inside) + 1 + len(rest) - len(rest.lstrip()) + 1
        findings.error(number, column, f"unexpected text after the section: {quoted(rest.strip())}")
    # Keep the section in spite of the error, so that its entries are not added to the section before.
    sections.append(SectionText(Word(name, number, start + 1)))


def _add_entry(line: str, number: int, sections: list[SectionText], findings: Findings) -> None:
    left, equals, right = line.partition("=")
    column = len(left) - len(left.lstrip()) + 1
    key = " ".join(left.split())
    if not equals:
        findings.error(number, column, f"expected key = value, found {quoted(key)}")
    elif not key:
        findings.error(number, column, 'expected a key before "="')
    elif not sections:
        findings.error(
            number, column, f"{quoted(key)} is before the first section: add one, such as [Groups]"
        )
    else:
        words = _WORD.finditer(right)
        values = tuple(Word(m.group(), number, len(left) + 1 + m.start() + 1) for m in words)
        sections[-1].entries.append(Entry(Word(key, number, column), values))
