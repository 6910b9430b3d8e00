"""Generate docs/reference/generated/audit-events.md, from the registry and from the calls that record events.

These calls define the fields of `detail`, and the severities that the registry lacks. `ELSEWHERE` lists the fields of
events whose calls do not show them, such as the log's own records and the actions of monitors.
"""

import ast
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from appliance.audit.log.events import EVENTS, SEVERITIES
from appliance.audit.log.record import Severity
from appliance.audit.log.repetition import ABOUT, PARAMETERS
from distribution import fact_cache
from distribution.checkout import ROOT
from distribution.fact_cache import facts_of_files

_FIELDS = frozenset(
    {
        "severity",
        "host",
        "caller_id",
        "category",
        "resource",
        "rule",
        "decision",
        "more",
        "reads",
        "reason",
        "whole",
    }
)
_FOLDED = (
    "count", "of", "scope", "recorded_id", "first_id", "last_id", "first_time", "last_time", *ABOUT,
    PARAMETERS, "callers", "resources", "calls", "hosts", "reasons", "recovered",
)  # fmt: skip
_LOGS_OWN = {
    "log begun": ("log", "earlier_log_missing"),
    "log failed": ("since", "until"),
    "records lost": ("count", "first_time", "last_time"),
    "checkpoint": ("number", "sequence", "hash"),
    "log replaced": ("log", "number", "hash"),
    "log set aside": ("log", "number", "hash"),
    "signature refused": ("number",),
    "disk nearly full": ("left",),
    "disk has room": ("left",),
    "records removed": (
        "first_sequence", "last_sequence", "last_hash", "first_time", "last_time", "last_checkpoint",
        "last_checkpoint_hash", "count", "kept", "limit", "signature", "key",
    ),
}  # fmt: skip
_MONITOR = (
    "monitor", "happened", "number", "seq", "stamp", "before", "after", "before_fields", "after_fields", "size",
    "count", "first_time", "last_time", "first_text", "last_text",
)  # fmt: skip
_LED = ("at", "events", "timer", "conditions")
ELSEWHERE: dict[str, tuple[str, ...]] = {
    **_LOGS_OWN,
    "decision": ("call", "key", "node", "subgraph", "needs", "parts", "unknown_host"),
    "revoked": ("call", "needs"),
    "denials folded": _FOLDED,
    "repetitions folded": _FOLDED,
    "monitor log": (*_MONITOR, "level"),
    "monitor fault": (*_MONITOR, *_LED, "values"),
    "monitor verdict": (*_MONITOR, *_LED, "why"),
    "message dropped": (*_MONITOR, *_LED, "values", "handler", "why"),
    "monitor published": (*_MONITOR, "because_of", *_LED, "handler", "why"),
    "message changed": (*_MONITOR, "changed_by", *_LED),
    "shadow observed": (*_MONITOR, "changed_by", "shadow", "would", *_LED, "values", "handler", "why"),
}  # fmt: skip

_HEAD = """\
# Audit events

Every event by its stable name (`rosrv audit search --event NAME`), what it means, the severities it is recorded
with, and the fields of its `detail`. The fields that every record has are in [audit-log.md](../audit-log.md). A name is
never renamed or given another meaning.

| event | meaning | severity | fields of `detail` |
|---|---|---|---|
"""


class EventUse(NamedTuple):
    """A call that records an event with a literal name."""

    event: str
    place: str
    severities: frozenset[str]
    fields: tuple[str, ...]
    denies: bool


class _Recorded(NamedTuple):
    """The events that a module records."""

    uses: tuple[EventUse, ...]
    written: frozenset[str]


@cache
def _modules() -> tuple[_Recorded, ...]:
    paths = sorted((ROOT / "appliance").rglob("*.py"))
    usual = map(str, sorted(SEVERITIES.items()))
    code = (__file__, fact_cache.__file__)
    return tuple(facts_of_files(_Recorded, _recorded, paths, code=code, context=usual).values())


def _recorded(path: Path) -> _Recorded:
    text = path.read_text(encoding="utf-8")
    within, place = fact_cache.nodes(ast.parse(text)), path.relative_to(ROOT / "appliance")
    calls = (node for node in within if isinstance(node, ast.Call))
    uses = tuple(use for node in calls for use in _use(node, f"{place}:{node.lineno}"))
    return _Recorded(uses, frozenset(_written(within)))


def uses() -> Iterator[EventUse]:
    return (use for module in _modules() for use in module.uses)


def written() -> frozenset[str]:
    """Return the events that the code records: by a literal name, or by a name from a table of the same module.

    A name that is only compared, or only printed, records nothing.
    """
    return frozenset(name for module in _modules() for name in module.written)


def written_by(text: str) -> Iterator[str]:
    """Yield the events that a module records."""
    return _written(fact_cache.nodes(ast.parse(text)))


def _written(nodes: Sequence[ast.AST]) -> Iterator[str]:
    events = [event for node in nodes if isinstance(node, ast.Call) and (event := _event(node)) is not None]
    yield from (name for event in events for name in _texts(event))
    if any(not [*_texts(event)] for event in events):
        no_record = {
            id(part)
            for node in nodes
            if isinstance(node, ast.Compare) or (isinstance(node, ast.Call) and _prints(node))
            for part in ast.walk(node)
        }
        yield from (name for node in nodes if id(node) not in no_record for name in _texts(node))


def _prints(node: ast.Call) -> bool:
    owner = node.func.value if isinstance(node.func, ast.Attribute) else None
    return isinstance(owner, ast.Name) and owner.id in ("log", "_log")


def _called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def _event(node: ast.Call) -> ast.expr | None:
    """Return the expression for the event of a call that records one."""
    called = _called(node)
    named = {one.arg: one.value for one in node.keywords if one.arg is not None}
    if called in ("AuditRecord", "WriteRecord") and "event" in named:
        return named["event"]
    records = called in ("happened", "_own", "_make", "AuditRecord", "WriteRecord", "_record") and node.args
    return node.args[0] if records else None


def _use(node: ast.Call, place: str) -> Iterator[EventUse]:
    called, event = _called(node), _event(node)
    if event is None:
        return
    named = {one.arg: one.value for one in node.keywords if one.arg is not None}
    fields = tuple(name for name in named if name not in _FIELDS) if called == "happened" else ()
    for name in _texts(event):
        denies = "decision" in named and any("deny" in _texts(one) for one in ast.walk(named["decision"]))
        yield EventUse(name, place, _severities(node, called, name), fields, denies)


def _texts(node: ast.AST) -> Iterator[str]:
    """Yield a literal, or both literals of a conditional expression."""
    match node:
        case ast.Constant(value=str(text)):
            yield text
        case ast.IfExp(body=one, orelse=other):
            yield from _texts(one)
            yield from _texts(other)


def _severities(node: ast.Call, called: str, event: str) -> frozenset[str]:
    known = {one.name: one.value for one in Severity}
    found = {
        known[one.attr]
        for one in ast.walk(node)
        if isinstance(one, ast.Attribute) and getattr(one.value, "id", "") == "Severity" and one.attr in known
    }
    plain = not any(one.arg == "severity" for one in node.keywords)
    usual = SEVERITIES.get(event, Severity.INFO).value
    return frozenset(found or ({usual} if called in ("happened", "_record") and plain else set()))


def markdown() -> str:
    severities: dict[str, set[str]] = {name: set() for name in EVENTS}
    fields: dict[str, list[str]] = {name: list(ELSEWHERE.get(name, ())) for name in EVENTS}
    for use in uses():
        if use.event in EVENTS:
            severities[use.event] |= use.severities
            fields[use.event] += [one for one in use.fields if one not in fields[use.event]]
    order = [one.value for one in Severity]
    rows = [
        f"| `{name}` | {meaning} | {', '.join(sorted(severities[name], key=order.index)) or 'by case'} |"
        f" {', '.join(f'`{one}`' for one in fields[name]) or '-'} |"
        for name, meaning in EVENTS.items()
    ]
    return _HEAD + "\n".join(rows) + "\n"
