"""Read `[Ports]`, `[Monitor]` and `[Options]`, which do not decide requests."""

import re
from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace

from appliance.base.validation_messages import meant
from appliance.policy.ini_reader import Entry, SectionText, is_repeated
from appliance.policy.model import TELLS
from appliance.policy.policy import DEFAULT_PORTS
from appliance.policy.policy_findings import Findings, quote
from appliance.policy.sections import DECIDERS
from roswire.names import is_global_name

TAKEOVERS = ("same-host", "granted")
AT_ONCE = "[Options] takeover = granted"
"""The option that lets another host take over a node name; a denial that it would prevent names it."""
_MASTER_PORT = 11311
_RANGE = re.compile(r"([0-9]{1,5})-([0-9]{1,5})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Options:
    """Takeover of node names, sections in audit-only mode, and the text for denied hosts."""

    takeover: str = TAKEOVERS[0]
    audit_only: frozenset[str] = frozenset()
    tell: str = TELLS[0]


@dataclass(frozen=True, slots=True)
class MonitorSection:
    """Topics and services that are relayed even without a specification."""

    topics: frozenset[str] = frozenset()
    services: frozenset[str] = frozenset()


def read_ports(section: SectionText | None, findings: Findings) -> range:
    ports = DEFAULT_PORTS
    for entry in _entries(section, ("range",), findings):
        ports = _range(entry, findings) or DEFAULT_PORTS
    return ports


def _range(entry: Entry, findings: Findings) -> range | None:
    word = entry.values[0] if entry.values else entry.key
    match = _RANGE.fullmatch("".join(value.text for value in entry.values))
    first, last = (int(match[1]), int(match[2])) if match else (0, 0)
    if not match:
        findings.error(word, "expected range = FIRST-LAST, such as 19001-20000")
    elif not 1024 <= first < last <= 65535:
        text = f"{first}-{last}: the range must be ascending, within 1024 to 65535, two ports for each node"
        findings.error(word, text)
    elif first <= _MASTER_PORT <= last:
        findings.error(word, f"{first}-{last} contains {_MASTER_PORT}, the port of RVMaster")
    else:
        return range(first, last + 1)
    return None


def read_monitor(section: SectionText | None, findings: Findings) -> MonitorSection:
    names: dict[str, set[str]] = {"topic": set(), "service": set()}
    for entry in _entries(section, tuple(names), findings):
        for word in entry.values:
            if not is_global_name(word.text):
                text = f"{quote(word.text)} is not a resolved name (/landshark/gps) without patterns"
                findings.error(word, text)
            elif word.text in names[entry.key.text]:
                findings.warn(word, f"{word.text} is listed twice")
            names[entry.key.text].add(word.text)
    return MonitorSection(frozenset(names["topic"]), frozenset(names["service"]))


def read_options(section: SectionText | None, findings: Findings) -> Options:
    options = Options()
    for entry in _entries(section, ("takeover", "audit-only", "tell"), findings):
        match entry.key.text:
            case "takeover":
                options = replace(options, takeover=_one_of(entry, TAKEOVERS, findings))
            case "tell":
                options = replace(options, tell=_one_of(entry, TELLS, findings))
            case _:
                options = replace(options, audit_only=_audit_only(entry, findings))
    return options


def _one_of(entry: Entry, words: Sequence[str], findings: Findings) -> str:
    text = " ".join(word.text for word in entry.values)
    if text not in words:
        word = entry.values[0] if entry.values else entry.key
        shown = f"{entry.key.text} is {' or '.join(words)}, not {quote(text)}{meant(text, words)}"
        findings.error(word, shown)
    return text


def _audit_only(entry: Entry, findings: Findings) -> frozenset[str]:
    by_fold = {decider.name.casefold(): decider.name for decider in DECIDERS}
    chosen: set[str] = set()
    for word in entry.values:
        text = word.text.strip("[]").casefold()
        if text == "all":
            chosen.update(by_fold.values())
        elif text in by_fold:
            chosen.add(by_fold[text])
        else:
            guess = meant(word.text, ["all", *by_fold.values()])
            known = "" if guess else f"; all, or some of {', '.join(by_fold.values())}"
            findings.error(word, f"{quote(word.text)} decides nothing{guess}{known}")
    if chosen:
        what = "are" if len(chosen) == len(by_fold) else f"by [{'], ['.join(sorted(chosen))}] are"
        findings.warn(entry.key, f"audit-only: denials {what} only recorded")
    return frozenset(chosen)


def _entries(section: SectionText | None, keys: Collection[str], findings: Findings) -> Iterator[Entry]:
    first_lines: dict[Hashable, int] = {}
    for entry in section.entries if section else ():
        word = entry.key
        if word.text not in keys:
            guess = (
                meant(word.text, keys) or f"; [{section.name.text if section else ''}] has {', '.join(keys)}"
            )
            findings.error(word, f"unknown key {quote(word.text)}{guess}")
        elif not is_repeated(word.text, word, first_lines, findings):
            yield entry
