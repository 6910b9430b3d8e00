"""Write the generated pages (`make pages`): those in `docs/reference/generated`, and a part of three others."""

import ast
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from appliance.audit.log.events import EVENTS, SEVERITIES
from appliance.audit.log.record import Severity
from appliance.audit.log.repetition import ABOUT, PARAMETERS
from appliance.audit.log.schema import FIELDS
from appliance.channel.alarms import ALARM_KINDS
from appliance.configuration.settings import Settings
from appliance.features.table import FEATURES, members
from appliance.quotas.table import AUDIT_RESERVE, AUDIT_ROBOT_PART, QUOTA_ROWS, QuotaRow
from distribution import command_line_page, fact_cache
from distribution.checkout import ROOT, BuildError
from distribution.fact_cache import facts_of_files

# Generate docs/reference/generated/appliance-yaml.md.

_SETTINGS_HEAD = """# appliance.yaml

`rosrv config show` prints the value of every key on your machine, `rosrv config check FILE` every error of a file. A
key can also be given in the environment, as `ROSRV_` and its name in capitals, with two underscores between section and
key: `ROSRV_AUDIT__DURABILITY=strict` ([order](../../operating.md#the-settings)).

Sizes are bytes, or take a unit (`64MiB`). Relative paths, defaults too, are below the folder of the file.

"""
_TABLE = "| key | default | values | meaning |\n|---|---|---|---|\n"
_BOUNDS = {
    "exclusiveMinimum": "above {:,}",
    "minimum": "from {:,}",
    "exclusiveMaximum": "below {:,}",
    "maximum": "to {:,}",
    "gt": "above {:,}",
    "ge": "from {:,}",
}
_TYPES = {
    "string": "text",
    "integer": "integer",
    "number": "number",
    "boolean": "`true`, `false`",
    "object": "map of lists of text",
    "null": "`null`",
}


def settings_markdown() -> str:
    schema = TypeAdapter(Settings).json_schema()
    sections: list[tuple[str, dict[str, Any]]] = []
    top = _rows(schema, schema["$defs"], "", sections)
    text = _SETTINGS_HEAD + _TABLE + "".join(top)
    for name, section in sections:
        about = section.get("description", "").split("\n\n", maxsplit=1)[0]
        text += f"\n## {name}\n\n{' '.join(about.split())}\n\n{_TABLE}"
        text += "".join(_rows(section, schema["$defs"], f"{name}.", sections))
    return text


def _rows(
    schema: dict[str, Any], defined: dict[str, Any], prefix: str, sections: list[tuple[str, dict[str, Any]]]
) -> Iterator[str]:
    for key, value in schema["properties"].items():
        if "$ref" in value:
            sections.append((prefix + key, defined[value["$ref"].rpartition("/")[2]]))
            continue
        missing = "`{}`" if value.get("type") == "object" else "by machine"
        default = f"`{json.dumps(value['default'])}`" if "default" in value else missing
        values = _values(value, defined).removesuffix(" or `null`" if default == "`null`" else "")
        meaning = " ".join(value["description"].split())
        yield f"| `{key}` | {default} | {values} | {meaning} |\n".replace("`null`", "none")


def _values(value: dict[str, Any], defined: dict[str, Any]) -> str:
    if "$ref" in value:
        keys = defined[value["$ref"].rpartition("/")[2]]["properties"]
        return "{" + ", ".join(f"{name}: …" for name in keys) + "}"
    if "enum" in value:
        return ", ".join(f"`{one}`" for one in value["enum"])
    bounds = " ".join(text.format(value[name]) for name, text in _BOUNDS.items() if name in value)
    if "anyOf" in value:
        kinds = list(dict.fromkeys(_values(one, defined) for one in value["anyOf"]))
        if "size with a unit" in kinds:
            kinds = ["size" if one == "size with a unit" else one for one in kinds if one != "integer from 0"]
        return " ".join(
            [" or ".join("size" if one == "text of size" else one for one in kinds), bounds]
        ).strip()
    if value.get("type") == "array":
        return f"list of {_values(value.get('items', {}), defined)}"
    if value.get("pattern", "").startswith("^\\s*(\\d*"):
        return "size with a unit"
    kind = "path" if value.get("format") == "path" else _TYPES.get(value.get("type", ""), "text")
    return f"{kind} {bounds}".strip()


# Generate docs/reference/generated/quotas.md.

_QUOTAS_HEAD = """# Quotas of finite resources

An *unknown host* is an address that no rule of the policy names, or that an operator blocks; all unknown hosts share
one quota. The *kept* part is for hosts with a registration only, so the robot's own nodes find it free at any time.
`[Ports]` and `[Limits]` are sections of the policy; the other settings are keys of `appliance.yaml`.

The [margins](#margins-the-honest-use-that-comes-closest) are those of a large robot (200 nodes on one machine and 5,000
parameters, started 20 times in a row) and of many browsers: computed, not measured. Resources that allow at least twice
such a use, or for which it has no number, are left out there.
"""
_FREE = 512 << 20  # bytes of the disk, in the margin of audit records


def all_rows() -> tuple[QuotaRow, ...]:
    return (*QUOTA_ROWS, *(row for feature in FEATURES for row in feature.quotas))


def page() -> str:
    return "\n".join((_QUOTAS_HEAD, *_tables()))


def _tables() -> Iterator[str]:
    yield _table(
        "Sizes",
        ("resource", "whole", "one host", "unknown hosts together", "kept", "setting"),
        lambda row: (
            row.thing,
            *(f"{one:,}" for one in (row.bounds.whole, row.bounds.host, row.bounds.unknown, row.bounds.kept)),
            _setting(row),
        ),
    )
    yield _table(
        "At the limit",
        ("resource", "effect on the host", "order among hosts", "alarm", "definitions that differ"),
        lambda row: (_short(row.thing), row.at_limit, row.between, row.alarm, row.counting),
    )
    yield _table(
        "Margins: the honest use that comes closest",
        ("resource", "use", "it needs", "allowed", "times", "beyond it"),
        lambda row: _margin(row) if bound_of(row) < 2 * row.margin.needs else None,
    )


def _short(thing: str) -> str:
    return re.split(r": | \(|; |, (?:beyond|in percent|including|also|divided) ", thing)[0]


def bound_of(row: QuotaRow) -> int:
    """Return the bound that the honest use of a row meets first."""
    bounds = row.bounds
    match row.margin.of:
        case "whole":
            return bounds.whole
        case "unkept":
            return bounds.whole - bounds.kept
        case "robot":
            return (bounds.whole if row is AUDIT_RESERVE else _FREE) // AUDIT_ROBOT_PART
    return bounds.host


def _margin(row: QuotaRow) -> tuple[str, ...]:
    use, needs, _, beyond = row.margin
    return _short(row.thing), use, f"{needs:,}", f"{bound_of(row):,}", f"{bound_of(row) / needs:.1f}", beyond


def _table(title: str, columns: tuple[str, ...], cells: Callable[[QuotaRow], tuple[str, ...] | None]) -> str:
    rows = (found for row in all_rows() if (found := cells(row)) is not None)
    lines = (columns, ("---",) * len(columns), *rows)
    return f"## {title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _setting(row: QuotaRow) -> str:
    key, space, note = row.setting.partition(" ")
    return f"`{key}`{space}{note}" if key else ""


# Generate the end of docs/reference/metrics.md: the table of all metrics.


def metrics_markdown() -> str:
    lines = ["| metric | kind | labels | meaning |", "|---|---|---|---|"]
    [rows] = members("metric_table", "METRICS")
    lines += [f"| `{row.name}` | {row.kind} | {_codes(row.labels) or '-'} | {row.help} |" for row in rows]
    return "\n".join([*lines, ""])


# Generate the end of docs/reference/audit-log.md: the fields of audit records.

CHAIN = {
    "previous": "hash of the record before",
    "hash": "hash of this record",
    "then": "list of the hashes of the contents of records that were left out after it; null in records of 0.1.0",
    "checkpoint": "signed checkpoint that seals the records up to this one (`rosrv audit checkpoints`), or null",
}
_FORMS = {"string": "text", "integer": "integer", "object": "object", "null": "null"}


def audit_record_markdown() -> str:
    lines = ["## Fields of a record", "", "| field | value | meaning |", "|---|---|---|"]
    lines += [f"| `{name}` | {_form(form)} | {text} |" for name, (form, text) in FIELDS.items()]
    lines += [
        "",
        "A record has all of these fields (`decision` only if something was decided), and no others. A line of an",
        "export also has `robot`, if `appliance.yaml` names the robot and the appliance runs, and `chain`, its",
        "place in the hash chain:",
        "",
        *(f"- `{name}`: {text}" for name, text in CHAIN.items()),
        "",
        "`GET /v1/openapi.json` has the JSON schema, `AuditRecord`.",
        "The names of `event`, each with its fields of `detail`: [audit-events.md](generated/audit-events.md).",
        "",
    ]
    return "\n".join(lines)


def _form(form: dict[str, Any]) -> str:
    if "enum" in form:
        return ", ".join(f"`{one}`" for one in form["enum"])
    if "const" in form:
        return f"`{form['const']}`"
    kinds = form["type"] if isinstance(form["type"], list) else [form["type"]]
    text = " or ".join(_FORMS[one] for one in kinds)
    if "properties" in form:
        text += ": " + ", ".join(f"`{one}`" for one in form["properties"])
    return f"{text} `{form['pattern']}`" if "pattern" in form else text


# Generate docs/reference/generated/audit-events.md, from the registry and from the calls that record events.
#
# These calls define the fields of `detail`, and the severities that the registry lacks. `ELSEWHERE` lists the fields
# of events whose calls do not show them, such as the log's own records and the actions of monitors.

_FIELDS = frozenset({
    "severity", "host", "caller_id", "category", "resource", "rule", "decision", "more", "reads", "reason", "whole",
})  # fmt: skip
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
_UNKNOWN, _PASSED = "?", "**"
_NOTHING = ast.Constant(0)
_Scope = ast.FunctionDef | ast.AsyncFunctionDef | None
_LED = ("at", "events", "timer", "conditions")
ELSEWHERE: dict[str, tuple[str, ...]] = {
    **_LOGS_OWN,
    "evidence exported": ("robot",),
    "guard tested": tuple(
        name
        for test in members("guard_answers", "ProofTest")
        for name in test.__struct_fields__
        if name not in ("at", "who")
    ),
    "decision": ("call", "key", "node", "subgraph", "needs", "parts", "unknown_host"),
    "revoked": ("call", "needs"),
    "denials folded": _FOLDED,
    "repetitions folded": _FOLDED,
    "monitor log": (*_MONITOR, "level"),
    "monitor fault": (*_MONITOR, *_LED, "values"),
    "monitor verdict": (*_MONITOR, *_LED, "why"),
    "message dropped": (*_MONITOR, *_LED, "values", "handler", "why"),
    **dict.fromkeys(("monitor published", "monitor called"), (*_MONITOR, "because_of", *_LED, "handler", "why")),
    "stop begun": (*_MONITOR, "changed_by", "because_of", *_LED, "handler", "why"),
    "message changed": (*_MONITOR, "changed_by", *_LED),
    "shadow observed": (*_MONITOR, "changed_by", "shadow", "would", *_LED, "values", "handler", "why"),
}  # fmt: skip

_HEAD = """\
# Audit events

Every event by its stable name (`rosrv audit search --event NAME`), what it means, the severities it is recorded
with, and the fields of its `detail`. The fields that every record has are in [audit-log.md](../audit-log.md). A name is
never renamed or given another meaning. `who` is the author, as in `rosrv audit search --who`.

Three words stand for many fields:

- *message*: {message}
- *place*: {place}
- *folded*: {folded}

`at` is the location of the monitor's statement, and `conditions` has those that led there, with the values that they
compared. `handler` is the verdict whose handler ran, with its `why`.

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


class _Helper(NamedTuple):
    """A function that records an event for its caller: the one of an argument, by its number, or always the same."""

    function: ast.FunctionDef | ast.AsyncFunctionDef
    event: int | ast.expr
    fields: tuple[str, ...]


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
    scopes = {
        id(call): function
        for function in within
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for call in fact_cache.nodes(function)
        if isinstance(call, ast.Call)
    }
    calls = [(node, scopes.get(id(node))) for node in within if isinstance(node, ast.Call)]
    helpers = {helper.function.name: helper for call in calls for helper in _helper(*call)}
    uses = tuple(
        use for node, scope in calls for use in _use(node, f"{place}:{node.lineno}", scope, helpers, within)
    )
    return _Recorded(uses, frozenset(_written(within)))


def uses() -> Iterator[EventUse]:
    return (use for module in _modules() for use in module.uses)


def recorded_events() -> frozenset[str]:
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


def _called_name(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def _event(node: ast.Call) -> ast.expr | None:
    """Return the expression for the event of a call that records one."""
    called = _called_name(node)
    named = {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg is not None}
    if called in ("AuditRecord", "WriteRecord") and "event" in named:
        return named["event"]
    records = called in ("happened", "_own", "_make", "AuditRecord", "WriteRecord", "_record") and node.args
    return node.args[0] if records else None


def _helper(node: ast.Call, scope: _Scope) -> Iterator[_Helper]:
    """Yield the function of a call that takes the event, or further fields, from its own caller."""
    event = _event(node) if _called_name(node) == "happened" else None
    if scope is not None and event is not None:
        fields = tuple(_fields(node, scope))
        parameters = [one.arg for one in scope.args.args if one.arg != "self"]
        if isinstance(event, ast.Name) and event.id in parameters:
            yield _Helper(scope, parameters.index(event.id), fields)
        elif _PASSED in fields:
            yield _Helper(scope, event, fields)


def _fields(node: ast.Call, scope: _Scope) -> Iterator[str]:
    """Yield the fields of `detail` in a call of `happened`, or in the `partial` of it that is called."""
    for keyword in node.keywords:
        if keyword.arg in (None, "more"):
            yield from _keys(keyword.value, scope)
        elif keyword.arg not in _FIELDS:
            yield keyword.arg
    if isinstance(node.func, ast.Name):
        made = [value for value in _values_of(node.func.id, scope) if isinstance(value, ast.Call)]
        yield from (field for one in made for field in _fields(one, scope))


def _keys(node: ast.expr, scope: _Scope) -> Iterator[str]:
    """Yield the keys of a mapping; `_PASSED` for those that the caller gives, and `_UNKNOWN` if they cannot be read."""
    match node:
        case ast.Constant(value=None):
            pass
        case ast.Constant(value=str(key)):
            yield key
        case ast.IfExp(body=one, orelse=other):
            yield from (*_keys(one, scope), *_keys(other, scope))
        case ast.Dict(keys=keys, values=values):
            for word, value in zip(keys, values, strict=True):
                yield from _keys(value if word is None else word, scope)
        case ast.Name(id=name) if scope and scope.args.kwarg and scope.args.kwarg.arg == name:
            yield _PASSED
        case ast.Name(id=name):
            yield from (key for value in _values_of(name, scope) or [_NOTHING] for key in _keys(value, scope))
        case _:
            yield _UNKNOWN


def _values_of(name: str, scope: _Scope) -> list[ast.expr]:
    """Return what a function gives to a name, and the keys that it adds to it."""
    values: list[ast.expr] = []
    for node in fact_cache.nodes(scope) if scope else ():
        match node:
            case ast.Assign(targets=[ast.Name(id=given)], value=value) if given == name:
                values.append(value)
            case ast.AugAssign(target=ast.Name(id=given), value=value) if given == name:
                values.append(value)
            case ast.Assign(targets=[ast.Subscript(value=ast.Name(id=given), slice=key)]) if given == name:
                values.append(key)
    return values


def _events_of(event: ast.expr, scope: _Scope, module: Sequence[ast.AST]) -> Iterator[str]:
    """Yield the events that an expression may be: a literal, a name that the function gives, or a row of a table."""
    match event:
        case ast.Name(id=name):
            yield from (text for value in _values_of(name, scope) for text in _texts(value))
        case ast.Subscript(value=ast.Name(id=name)):
            for node in module:
                match node:
                    case ast.AnnAssign(target=ast.Name(id=table), value=ast.Dict(values=rows)) if (
                        table == name
                    ):
                        yield from (text for row in rows for text in _texts(row))
        case _:
            yield from _texts(event)


def _use(
    node: ast.Call, place: str, scope: _Scope, helpers: Mapping[str, _Helper], module: Sequence[ast.AST]
) -> Iterator[EventUse]:
    called, event = _called_name(node), _event(node)
    named = {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg is not None}
    fields = [*_fields(node, scope)] if called == "happened" else [_UNKNOWN]
    helper = helpers.get(called)
    if helper is not None and (not isinstance(helper.event, int) or len(node.args) > helper.event):
        known = {one.arg for one in (*helper.function.args.args, *helper.function.args.kwonlyargs)}
        passed = [
            field
            for keyword in node.keywords
            if keyword.arg not in known
            for field in (_keys(keyword.value, scope) if keyword.arg is None else [keyword.arg])
        ]
        called, event = "happened", node.args[helper.event] if isinstance(helper.event, int) else helper.event
        fields = [one for name in helper.fields for one in (passed if name == _PASSED else [name])]
    fields = [field for field in fields if field not in {*_FIELDS, _PASSED}]
    if event is None:
        return
    for name in _events_of(event, scope, module):
        denies = "decision" in named and any("deny" in _texts(one) for one in ast.walk(named["decision"]))
        yield EventUse(name, place, _severities(node, called, name), tuple(dict.fromkeys(fields)), denies)


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
    plain = not any(keyword.arg == "severity" for keyword in node.keywords)
    usual = SEVERITIES.get(event, Severity.INFO).value
    return frozenset(found or ({usual} if called == "happened" and plain else set()))


def audit_events_markdown() -> str:
    severities: dict[str, set[str]] = {name: set() for name in EVENTS}
    read: set[str] = set()
    fields: dict[str, list[str]] = {name: list(ELSEWHERE.get(name, ())) for name in EVENTS}
    for use in uses():
        if use.event in EVENTS:
            severities[use.event] |= use.severities
            fields[use.event] += [field for field in use.fields if field not in fields[use.event]]
            read.add(use.event)
    unread = [
        name for name in EVENTS if name not in ELSEWHERE and (name not in read or _UNKNOWN in fields[name])
    ]
    if unread:
        raise BuildError(f"no call shows the fields of {', '.join(unread)}: list them in `ELSEWHERE`")
    order = [one.value for one in Severity]
    groups = {"message": _codes(_MONITOR), "place": _codes(_LED), "folded": _codes(_FOLDED)}
    rows = []
    for name, meaning in EVENTS.items():
        cell = _codes(one for one in fields[name] if one != _UNKNOWN) or "-"
        for group, codes in groups.items():
            cell = cell.replace(codes, f"*{group}*")
        severity = ", ".join(sorted(severities[name], key=order.index)) or "by case"
        rows.append(f"| `{name}` | {meaning} | {severity} | {cell} |\n")
    return _HEAD.format(**groups) + "".join(rows)


def _codes(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


_BEGIN, _END = "<!-- generated by `make pages` -->\n", "<!-- end of the generated part -->\n"


def order_of_guards() -> str:
    """Return the table of presets whose order changes what they promise."""
    [order] = members("guard_order", "PRECEDENCES")
    rows = "".join(f"| {_codes(one)} | {_codes(then)} | {otherwise} |\n" for one, then, otherwise in order)
    return f"| first | then | in the other order |\n|---|---|---|\n{rows}"


def evidence_about_guards() -> str:
    text: str = import_module("lab.guards_evidence_page").page()  # which needs the guards
    return text


_ALARMS_HEAD = """# Alarms

An *alarm* needs a person now and is red, a *warning* needs one soon, a *notice* needs none. With an alarm or a warning,
`rosrv status` exits with 1, except for `denials`, `drops`, `monitor-off` and `policy-audit-only`. A name may be
followed by `:` and what it is about; an order with the name alone is for all such alarms that are present.
`rosrv alarm list` has these.

| name | severity | what a person does |
|---|---|---|
"""


def alarms_markdown() -> str:
    rows = [f"| `{name}` | {kind.severity} | {kind.remedy} |\n" for name, kind in sorted(ALARM_KINDS.items())]
    return _ALARMS_HEAD + "".join(rows)


PAGES: Mapping[str, Callable[[], str]] = {
    "docs/reference/generated/alarms.md": alarms_markdown,
    "docs/reference/generated/appliance-yaml.md": settings_markdown,
    "docs/reference/generated/audit-events.md": audit_events_markdown,
    "docs/reference/generated/command-line.md": command_line_page.page,
    "docs/reference/generated/guards-evidence.md": evidence_about_guards,
    "docs/reference/generated/quotas.md": page,
    "docs/reference/audit-log.md": audit_record_markdown,
    "docs/reference/guards.md": order_of_guards,
    "docs/reference/metrics.md": metrics_markdown,
}


def present(page: str) -> str:
    """Return the text of a page in the checkout; empty if it does not exist."""
    path = ROOT / page
    return path.read_text(encoding="utf-8") if path.exists() else ""


def generate(page: str) -> str:
    """Return the text that a page should have; between its marks, if it has any, and unchanged elsewhere."""
    before, begin, rest = present(page).partition(_BEGIN)
    if not begin:
        return PAGES[page]()
    _, end, after = rest.partition(_END)
    return f"{before}{begin}{PAGES[page]()}{end}{after}"


if __name__ == "__main__":
    # A page that cannot be generated keeps its text, unlike with `> page`.
    try:
        texts = {page: generate(page) for page in PAGES}
    except BuildError as error:
        sys.exit(f"make pages: {error}")
    for changed, text in texts.items():
        (ROOT / changed).write_text(text, encoding="utf-8")
