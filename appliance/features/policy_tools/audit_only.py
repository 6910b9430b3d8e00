"""Take sections out of a policy's audit-only mode. No I/O."""

from collections.abc import Collection
from typing import NamedTuple

from appliance.policy.ini_reader import read
from appliance.policy.policy_findings import Findings
from appliance.policy.sections import DECIDERS, OPTIONS

_NAMES = {decider.name.casefold(): decider.name for decider in DECIDERS}


class EnforceError(ValueError):
    """The sections cannot be enforced; the message says why."""


class EnforcedAlreadyError(EnforceError):
    """The sections are enforced, so nothing is to be changed."""


class EnforcedText(NamedTuple):
    """A policy's text, and the sections that it enforces and the text before did not."""

    text: str
    sections: tuple[str, ...]


def enforced_text(text: str, sections: Collection[str] = ()) -> EnforcedText:
    """Return the text that enforces these sections, or all. Raises `EnforceError`.

    The line `audit-only` keeps the other sections and its comment, or is removed.
    """
    entry = next(
        (
            entry
            for section in read(text, Findings(""))
            if section.is_named(OPTIONS)
            for entry in section.entries
            if entry.key.text == "audit-only"
        ),
        None,
    )
    words = [] if entry is None else [word.text.strip("[]").casefold() for word in entry.values]
    lenient = list(_NAMES.values()) if "all" in words else [_NAMES[word] for word in words if word in _NAMES]
    if entry is None or not lenient:
        raise EnforcedAlreadyError("no section of the policy is audit-only: all of them are enforced already")
    named = [_section(name) for name in sections]
    chosen = [name for name in named if name in lenient] if named else lenient
    if not chosen:
        raise EnforcedAlreadyError(
            f"{', '.join(named)}: enforced already; audit-only are: {', '.join(lenient)}"
        )
    rest = [name for name in lenient if name not in chosen]
    lines = text.split("\n")
    place = entry.key.line - 1
    if rest:
        line, last = lines[place], entry.values[-1]
        end = last.column - 1 + len(last.text)
        lines[place] = f"{line[: entry.values[0].column - 1]}{' '.join(rest)}{line[end:]}"
    else:
        del lines[place]
    return EnforcedText("\n".join(lines), tuple(name for name in lenient if name in chosen))


def _section(name: str) -> str:
    section = _NAMES.get(name.strip("[]").casefold())
    if section is None:
        raise EnforceError(f"{name!a} is not a section that decides; these are: {', '.join(_NAMES.values())}")
    return section
