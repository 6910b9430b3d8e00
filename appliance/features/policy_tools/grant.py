"""Find the smallest change of a policy's text that grants a denied request. No I/O.

A new line for an exact key lists the host and all hosts of the deciding rule, so other hosts keep their rights. The
key for the anonymous name of a stock tool is a pattern, because its numbers change with each run.
"""

import difflib
import ipaddress
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Self

from appliance.base.durations import seconds_of
from appliance.features.policy_tools.learn import ROBOT
from appliance.features.policy_tools.stock_tools import StockTool, key_of, stock_tool
from appliance.policy.hours import UNTIL, host_units, instant
from appliance.policy.ini_reader import Entry, SectionText, Word, read
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.keys import levels
from appliance.policy.model import Address, Category, Request, Rule, word_of
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import Findings, PolicyError
from appliance.policy.policy_settings import TAKEOVERS
from appliance.policy.rights import Right, decide_right, rights_of, rights_of_call
from appliance.policy.sections import ASK, AUTHORITY, BY_CATEGORY, DEFAULT, GROUPS, OPTIONS, PARAMETERS

_MAX_LINES = 8  # the most lines that one grant may change, besides one for each right


NO_DECISION = (
    "it is not a record of a decision about a host's call: rosrv audit search --deny lists the denied ones"
)


class UngrantableError(Exception):
    """No rule can grant a request; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class DecidedRequest:
    """A request that was decided; `takeover`: it needs a node name that another host has.

    `wide` is a pattern for the first missing right, instead of its own name.
    """

    request: Request
    rights: list[Right]
    takeover: bool = False
    wide: str = ""

    def with_tool(self, tool: StockTool) -> Self:
        return replace(self, rights=[*tool.rights(self.request.host), *self.rights])


@dataclass(frozen=True, slots=True)
class GrantedText:
    """A changed text; `added` are the changed or new lines (none: the request was granted before)."""

    text: str
    added: tuple[str, ...]

    def findings(self, file: str, known: PolicyContext) -> list[str]:
        try:
            unsigned = replace(known, site_keys=())  # the new text cannot be signed yet
            judge(self.text, file, unsigned).accept()
        except PolicyError as error:
            return [str(finding) for finding in error.findings]
        return []

    def diff(self, before: str, file: str) -> list[str]:
        old, new = before.splitlines(), self.text.splitlines()
        return list(difflib.unified_diff(old, new, file, f"{file} (granted)", lineterm=""))


def grant(text: str, file: str, known: PolicyContext, asked: DecidedRequest, until: str = "") -> GrantedText:
    """Grant a request, until a date of the policy or for a time such as `7d`, or without an end.

    Raises `UngrantableError`, and `PolicyError` if the text is not a valid policy.
    """
    policy = known.compile(text, file)
    word = _word(text, known, policy, asked.request.host)
    if until:
        word = f"{word} {UNTIL} {_date(until, known, policy)}"
    block = replace(policy, blocks=known.blocks).block_of(asked.request.host)
    if block is not None:
        raise UngrantableError(f"no line of a policy grants it: {block.reason}")
    added: list[str] = []
    most = _MAX_LINES + len(asked.rights)
    while (
        missing := next((right for right in asked.rights if not _is_granted(policy, right)), None)
    ) is not None:
        decision = decide_right(policy, missing)
        reason, rule = decision.reason, decision.rule
        if rule is not None and rule.section == AUTHORITY:  # its line may be another one in the changed text
            raise UngrantableError(f"no right grants it: {reason.replace(f' ({rule.file}:{rule.line})', '')}")
        if len(added) == most:
            raise UngrantableError(f"more than {most} lines would have to change: {reason}")
        text, line = _change(policy, text, missing, word, "" if added else asked.wide)
        added.append(line)
        try:
            policy = known.compile(text, file)
        except PolicyError:  # the line is invalid: the call is unknown, or no key can name the resource
            raise UngrantableError(f"no line of a policy grants it: {reason}") from None
    if asked.takeover and policy.takeover != TAKEOVERS[-1]:
        text, line = _with_takeover(text)
        added.append(line)
    return GrantedText(text, tuple(added))


def _is_granted(policy: Policy, right: Right) -> bool:
    if right.request.category in PARAMETERS and right.request.category not in policy.present:
        return True
    decision = decide_right(policy, right)
    return decision.allowed and not decision.would_deny


def _word(text: str, known: PolicyContext, policy: Policy, host: Address) -> str:
    """Return the word for a host. A rule with an address of the robot's machine would take it out of `robot`."""
    enrolled = next((name for name, address in known.hosts.items() if address == host), None)
    if enrolled is not None:
        return word_of(enrolled)
    groups = next((section for section in _sections(text) if section.is_named(GROUPS)), None)
    for entry in groups.entries if groups is not None else ():
        if [word.text for word in entry.values] == [str(host)]:
            return entry.key.text
    return ROBOT if any(place.num_addresses == 1 and host in place for place in policy.robot) else str(host)


def _date(until: str, known: PolicyContext, policy: Policy) -> str:
    if known.now is None:
        raise UngrantableError("the appliance's clock is not set, so a right cannot get an end")
    seconds = seconds_of(until)
    try:
        if seconds is not None:
            end = datetime.fromtimestamp(known.now + max(60.0, seconds), policy.zone)
            until = f"{end:%Y-%m-%dT%H:%M}"
        if instant(until, policy.zone) <= known.now:
            raise UngrantableError(f"{until} has passed")
    except (ValueError, OverflowError) as error:
        raise UngrantableError(
            f"{error} (in the zone of the policy, {policy.zone}), or a time such as 7d"
        ) from None
    return until


def _sections(text: str) -> list[SectionText]:
    return read(text, Findings(""))


def _change(policy: Policy, text: str, right: Right, word: str, wide: str = "") -> tuple[str, str]:
    request = right.request
    rule, key = decide_right(policy, right).rule, wide or _key(request)
    name = BY_CATEGORY[request.category].name
    section = next((section for section in _sections(text) if section.is_named(name)), None)
    itself = policy.decide(request)
    if itself.allowed and not itself.would_deny:
        key = _below(request.resource, rule)  # a rule for something below the parameter denies the request
        if section is not None and word in _holders(section, f"{request.category} {key}"):
            # A pattern that also matches other names (/*/max) denies the request until all keys below have a rule.
            table = policy.tables[request.category]
            above = table.tree.inherited_value(request.resource) or table.default
            rule, key = above.rule if above is not None else None, _below(request.resource, None)
        if key == _below(request.resource, None) and itself.rule not in (None, rule):
            # The new key /arm/** also matches /arm. A key /arm of its own keeps the hosts of /arm.
            own = f"{request.category} {request.resource}"
            if section is not None and _entry(section, own) is None:
                rule, key = itself.rule, request.resource
    elif key == "/":  # not a valid key of a rule
        key = "/**"
    written = f"{request.category} {key}" if request.category in PARAMETERS else key
    entry = None if section is None else _entry(section, written)
    if entry is not None:
        return _with_word(text, entry, word)
    holders = [] if section is None or rule is None else _holders(section, rule.key)
    asking = holders.index(ASK) if ASK in holders else len(holders)
    plain = [holder for holder in holders[:asking] if holder.split()[0] != word.split(maxsplit=1)[0]]
    words = dict.fromkeys([*plain, word, *holders[asking:]])
    return _with_line(text, section, name, f"{written} = {' '.join(words)}")


def _key(request: Request) -> str:
    name = request.resource
    tool = stock_tool(f"/{levels(name)[0]}") if request.category in (Category.NODE, Category.OFFER) else None
    return name if tool is None else key_of(name)


def _below(name: str, rule: Rule | None) -> str:
    of_rule = rule.key.split(" ", 1)[-1] if rule is not None else DEFAULT
    own = of_rule[1:].split("/")[len(levels(name)) :] if of_rule != DEFAULT else []
    return "/".join([name.rstrip("/"), *(own or ["**"])])


def _entry(section: SectionText, key: str) -> Entry | None:
    return next((entry for entry in section.entries if " ".join(entry.key.text.split()) == key), None)


def _holders(section: SectionText, key: str) -> list[str]:
    entry = _entry(section, key)
    return [] if entry is None else [" ".join(map(_text, unit)) for unit in host_units(entry.values)]


def _with_word(text: str, entry: Entry, word: str) -> tuple[str, str]:
    lines = text.split("\n")
    line = lines[entry.key.line - 1]
    plain = [*itertools.takewhile(lambda value: value.text != ASK, entry.values)]
    for unit in host_units(plain):
        if unit[0].text == word.split(maxsplit=1)[0]:  # the host has the right at another time
            whole = " ".join(f"{line[: unit[0].column - 1]}{word}{line[_end(unit[-1]) :]}".split())
            lines[entry.key.line - 1] = f"{line[: unit[0].column - 1]}{word}{line[_end(unit[-1]) :]}"
            return "\n".join(lines), whole.partition("#")[0].partition(";")[0].rstrip()
    last: Word | None = plain[-1] if plain else None
    end = line.index("=") + 1 if last is None else _end(last)
    comma = "," if last is not None and "," in line[:end] else ""
    rule = f"{line[:end]}{comma} {word}"
    lines[entry.key.line - 1] = rule + line[end:]
    return "\n".join(lines), " ".join(f"{rule} {' '.join(map(_text, entry.values[len(plain) :]))}".split())


def _end(word: Word) -> int:
    return word.column - 1 + len(word.text)


def _text(word: Word) -> str:
    return word.text


def _with_takeover(text: str) -> tuple[str, str]:
    option = f"takeover = {TAKEOVERS[-1]}"
    section = next((section for section in _sections(text) if section.is_named(OPTIONS)), None)
    entry = None if section is None else _entry(section, "takeover")
    if entry is None:
        return _with_line(text, section, OPTIONS, option)
    lines, number, first = text.split("\n"), entry.key.line - 1, entry.values[0]
    rest = lines[number][first.column - 1 + len(first.text) :]
    lines[number] = f"{lines[number][: first.column - 1]}{TAKEOVERS[-1]}{rest}"
    return "\n".join(lines), option


def _with_line(text: str, section: SectionText | None, name: str, line: str) -> tuple[str, str]:
    lines, end = text.split("\n"), "\r" if "\r\n" in text else ""
    if section is None:
        while lines and not lines[-1].strip():
            lines.pop()
        return "\n".join([*lines, end, f"[{name}]{end}", f"{line}{end}", ""]), f"[{name}] {line}"
    last = section.entries[-1].key.line if section.entries else section.name.line
    # `default` is usually the last line. Insert the new line before it.
    if section.entries and section.entries[-1].key.text.endswith(DEFAULT):
        last -= 1
    return "\n".join([*lines[:last], f"{line}{end}", *lines[last:]]), line


def asked(
    host: str, caller_id: str, category: str, resource: str, detail: Mapping[str, object]
) -> DecidedRequest:
    """Return the request of a record. Raises `UngrantableError` for records without a decision."""
    try:
        request = Request(ipaddress.ip_address(host), caller_id, Category(category), resource)
    except ValueError:
        raise UngrantableError(NO_DECISION) from None
    call, key = str(detail.get("call", resource)), detail.get("key")
    if request.category is not Category.COMMAND:
        return DecidedRequest(request, rights_of(request))
    rights = rights_of_call(request, call, str(key) if key is not None else None)
    category, _, needed = str(detail.get("needs", "")).partition(" ")
    # The call may also have needed a right on another parameter. Only the record names that parameter.
    if category in PARAMETERS:
        right = replace(request, category=Category(category), resource=needed.removesuffix("/**") or "/")
        namespace = needed.endswith("/**")
        rights.append(Right(right, namespace=namespace, alone=not namespace))
    return DecidedRequest(request, rights)
