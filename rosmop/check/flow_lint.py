"""Warn of actions that pass an unsafe message, or stop a safe one, against their author's likely intention.

1. NaN comes out as permission: it skips a drop, a stop or a bound, at once or by way of shared variables.
2. A `return` drops a message against its purpose: on each path, after a field was assigned, or before the state was
updated that other topics are judged by.
3. An acceleration limit remembers a command that is stopped or dropped behind it.
"""

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, groupby, product
from typing import NamedTuple

from rosmop.check.abstract_values import (
    ANY,
    CALL,
    CAST,
    COMPARISON,
    DROPPED,
    LIVE,
    NAN,
    PASSES,
    SENT,
    TEST,
    UNKNOWN,
    AbstractParts,
    AbstractValue,
    Path,
    PathState,
    Places,
    is_shared,
    is_tainted,
    key_of,
    merge,
)
from rosmop.check.enforcement import bringing
from rosmop.check.flow import Exits, FlowAnalysis
from rosmop.check.flow_work import MAX_WORK, MAX_WORK_OF_SET, FlowLimitError, FlowWork
from rosmop.check.message_fields import PatternField
from rosmop.check.scope import CompilationContext
from rosmop.form import nodes
from rosmop.form.compiled import EventCode, PropertyCode, SpecificationCode
from rosmop.form.findings import Diagnostic
from rosmop.logics.property_lint import graph_of
from rosmop.types import value_types
from rosmop.types.messages import quote
from rosmop.types.value_types import Type

_MAX_LEAVES = 32
_ROUNDS = 2
_PROBES = (1e300, -1e300, 0.0, 1e-3)
_MIN_MAX = frozenset({"min", "max", "fmin", "fmax", "nearest"})


@dataclass(frozen=True)
class _Source:
    """The value that is NaN: a part of a field of a channel, or a shared variable; `name` is that in the text."""

    name: str
    channel: str | None = None
    path: str = ""
    site: int | None = None


@dataclass(eq=False)
class _Event:
    code: EventCode
    function: nodes.Function
    bound: Sequence[PatternField]
    fields: dict[str, str]
    """Variables of assigned fields, by flags."""
    restricts: bool
    exits: Exits = field(default_factory=dict)
    compared: set[str] = field(default_factory=set)
    """The inputs that are compared, bounded or converted."""
    operations: set[int] = field(default_factory=set)
    drops: dict[int, frozenset[str]] = field(default_factory=dict)
    """The sites that drop or replace the message, and the inputs on which they depend."""

    @property
    def channel(self) -> str | None:
        return self.code.channel

    def passed_states(self) -> list[PathState]:
        return [state for way, state in self.exits.items() if way.fate in PASSES]

    def suppressed_states(self) -> list[PathState]:
        return [state for way, state in self.exits.items() if way.fate not in PASSES]

    def sent_states(self) -> list[PathState]:
        return [state for way, state in self.exits.items() if way.fate == SENT]


class _Batch(NamedTuple):
    """Events that run one after the other, and the shared variables that they name."""

    number: int
    events: Sequence[_Event]
    shared: frozenset[str]


class SpecificationFlow:
    def __init__(self, shared: CompilationContext, code: SpecificationCode, work: FlowWork) -> None:
        self.code = code
        self._work = work
        self._forms, self._sites, self._messages = shared.functions, shared.symbols.sites, shared.messages
        self._variables = {variable: name for name, variable in code.variables.items()}
        own = next(names for names in shared.specifications if names.name == code.name)
        void = value_types.VOID
        self._helpers = [one for one in own.functions.values() if one.result == void and not one.references]
        brings = {name for one in code.properties for name in self._brings(one)}
        places = Counter(event.position for event in code.events)  # patterns with references add events
        self.events = [
            self._event(shared, event, brings=event.name in brings and places[event.position] == 1)
            for event in code.events
        ]
        for event in self.events:
            flow = self._flow(event)
            flow.given = {
                one.read: AbstractValue(inputs=frozenset(self._inputs(one)))
                for one in event.bound
                if one.read
            }
            event.exits = flow.event(event.function, PathState())
            event.compared, event.operations, event.drops = flow.compared, flow.operations, flow.drops
        self._batches = [*map(self._batch, count(), _batches(self.events))]
        self._followed: dict[Hashable, tuple[Places, dict[str, AbstractValue]]] = {}

    def findings(self) -> list[Diagnostic]:
        found = [*self._idle_returns()]
        for event in self.events:
            if event.code.topic is not None:
                found += self._returns(event)
        return [*found, *self._early_limits(), *self._permissions()]

    # Parts

    def _event(self, shared: CompilationContext, code: EventCode, *, brings: bool) -> _Event:
        function = self._forms[code.function]
        fields = {
            write.flag: node.name
            for statement in function.body
            if isinstance(statement, nodes.WriteBack)
            for write in statement.writes
            for node in nodes.walk(write.value)
            if isinstance(node, nodes.Read)
        }
        acts = any(isinstance(node, nodes.Drop | nodes.StopMessage) for node in nodes.walk(function.body))
        return _Event(
            code, function, shared.bound.get(code.function, ()), fields, acts or bool(fields) or brings
        )

    def _flow(self, event: _Event, source: int | None = None) -> FlowAnalysis:
        flow = FlowAnalysis(self._forms, event.fields, event.code.topic, work=self._work, source=source)
        flow.restricts = event.restricts
        return flow

    def _brings(self, code: PropertyCode) -> set[str]:
        found = set[str]()
        graph = graph_of(code.property)
        for category, name in code.handlers.items():
            if _suppresses(self._forms[name]) and graph is not None:
                found |= bringing(code.property, graph, category)
        return found

    def _inputs(self, pattern_field: PatternField) -> Iterator[str]:
        for path, _ in self._leaves(pattern_field):
            yield f"field {path}"
        if isinstance(pattern_field.type, value_types.IntegerType):
            yield f"whole {_path_of(pattern_field)}"

    def _leaves(self, pattern_field: PatternField) -> list[tuple[str, Path]]:
        """Return the floating-point numbers of a field: their names, and their paths in the value."""
        found: list[tuple[str, Path]] = []

        def walk(kind: Type, name: str, path: Path) -> None:
            if isinstance(kind, value_types.FloatingType):
                found.append((name, path))
            elif isinstance(kind, value_types.VectorType):
                walk(kind.element, f"{name}.*", (*path, ANY))
            elif isinstance(kind, value_types.RecordType) and len(path) < 6:
                for slot_name, slot in self._messages.slots(kind.name).items():
                    walk(slot.type, f"{name}.{slot_name}", (*path, slot.index))

        walk(pattern_field.type, _path_of(pattern_field), ())
        return found[:_MAX_LEAVES]

    # NaN

    def _permissions(self) -> Iterator[Diagnostic]:
        found: dict[tuple[str, int], str] = {}
        for source, start in self._sources():
            for place in self._passes(source, start):
                found.setdefault(place, source.name)
        seen = set[tuple[object, str]]()
        for (kind, site), name in sorted(found.items(), key=lambda item: item[0][1]):
            position, text = self._sites[site].position, _text(kind, name)
            if (position, text) not in seen:
                seen.add((position, text))
                yield Diagnostic(position, "warning", text)

    def _sources(self) -> Iterator[tuple[_Source, dict[str, AbstractValue]]]:
        reached = self._reached_inputs()
        known = set[tuple[str | None, str]]()
        for event in self.events:
            for one in event.bound:
                name = one.variable.name if one.variable is not None else ""
                for path, _ in self._leaves(one) if name else ():
                    if f"field {path}" in reached and (event.channel, path) not in known:
                        known.add((event.channel, path))
                        yield _Source(name, event.channel, path), {}
            for site in () if event.fields else event.operations:  # an event that scales judges its quotients
                yield _Source("", event.channel, site=site), {}
        start = PathState()
        for name in self.code.start:
            FlowAnalysis(self._forms, {}, None, work=self._work).event(self._forms[name], start)
        for variable, value in start.values.items():
            if value.is_nan and variable in reached:
                yield _Source(self._variables.get(variable, "")), {variable: AbstractValue(NAN)}

    def _reached_inputs(self) -> set[str]:
        """Return the inputs that come to a comparison, a bound or a conversion, perhaps by way of variables."""
        inputs = {name for event in self.events for name in event.compared}
        stored: dict[str, frozenset[str]] = {}
        for event in self.events:
            for state in event.exits.values():
                for name, value in state.values.items():
                    if is_shared(name):
                        stored[name] = stored.get(name, frozenset()) | value.inputs
        waiting = [*inputs]
        while waiting:
            more = stored.get(waiting.pop(), frozenset()) - inputs
            inputs |= more
            waiting += more
        return inputs

    def _passes(self, source: _Source, start: dict[str, AbstractValue]) -> Places:
        """Return the places where NaN skips what would restrict a message, and the message passes."""
        found: Places = frozenset()
        delta = start
        if not start:
            events = [event for event in self.events if event.channel == source.channel]
            found, after = self._judge(events, source, {})
            if found and source.path and not self._bounds(events, source):
                found = frozenset()
            if source.site is not None:
                found = frozenset(place for place in found if place[0] != TEST)
            delta = _tainted_variables(after)
        fresh = {name for name, value in delta.items() if is_tainted(value)}
        for _ in range(_ROUNDS):
            grown = dict(delta)
            for batch in self._batches:
                if fresh.isdisjoint(batch.shared):
                    continue  # as without NaN, or as in the round before
                places, after = self._follows(batch, delta)
                found |= {place for place in places if place[0] != TEST}
                grown |= {
                    name: value for name, value in after.items() if name not in grown and is_tainted(value)
                }
            fresh, delta = {*grown} - {*delta}, grown
        return found

    def _follows(
        self, batch: _Batch, delta: Mapping[str, AbstractValue]
    ) -> tuple[Places, dict[str, AbstractValue]]:
        """Judge a batch once for each set of values that it reads."""
        read = {name: value for name, value in delta.items() if name in batch.shared}
        key = (batch.number, frozenset((name, key_of(value)) for name, value in read.items()))
        if key not in self._followed:
            self._followed[key] = self._judge(batch.events, None, read)
        return self._followed[key]

    def _batch(self, number: int, events: Sequence[_Event]) -> _Batch:
        facts = (self._work.facts_of_function(event.function, self._forms) for event in events)
        return _Batch(number, events, frozenset[str]().union(*(fact.shared for fact in facts)))

    def _judge(
        self, events: Sequence[_Event], source: _Source | None, values: Mapping[str, AbstractValue]
    ) -> tuple[Places, dict[str, AbstractValue]]:
        """Run the events of a channel one after the other; return the places, and the variables afterwards."""
        live = [PathState(values=dict(values))]
        found: Places = frozenset()
        value = AbstractValue(NAN)
        for event in events:
            flow = self._flow(event, source.site if source is not None else None)
            own = self._give(flow, event, source, value) if source is not None else ""
            ends = [end for state in live for end in flow.event(event.function, state).items()]
            live = [after for way, after in ends if way.fate in PASSES]
            written = [one for after in live for one in _written_fields(event, after)]
            found = found.union(*(map(_badly, [*(one for _, one in written), *flow.published])))
            replaced = [one for variable, one in written if variable == own]
            if live and len(replaced) == len(live) and not any(map(_has_nan, replaced)):
                value = AbstractValue()
                for after in live:
                    after.skipped = frozenset()
            by_fate = ([after for after in live if after.fate == fate] for fate in PASSES)
            live = [merge(each) for each in by_fate if each]
        found = found.union(*(state.skipped for state in live if state.fate == LIVE))
        left = merge(live).values if live else {}  # where a message is stopped, so is what follows from it
        return found, {name: one for name, one in left.items() if is_shared(name)}

    def _give(self, flow: FlowAnalysis, event: _Event, source: _Source, value: AbstractValue) -> str:
        """Let the field of the source have a value; return the variable that is bound to the field, if any."""
        for one in event.bound:
            for path, inner in self._leaves(one):
                if path == source.path and one.read:
                    flow.given[one.read] = (
                        value if not inner else AbstractValue(AbstractParts({inner: value}))
                    )
                    return one.variable.code if one.variable is not None else ""
        return ""

    def _bounds(self, events: Sequence[_Event], source: _Source) -> bool:
        """Whether a number is stopped anywhere, or a large one is changed: else NaN has no privilege."""
        for number, event in product(_PROBES, events):
            flow = self._flow(event)
            self._give(flow, event, source, AbstractValue(number))
            for way, state in flow.event(event.function, PathState()).items():
                sent = _written_fields(event, state) if abs(number) > 1 else ()
                if way.fate != LIVE or not way.happened or any(value.known != number for _, value in sent):
                    return True
        return any(
            isinstance(node, nodes.Publish) for one in events for node in nodes.walk(one.function.body)
        )

    # Returns

    def _returns(self, event: _Event) -> Iterator[Diagnostic]:
        passed, suppressed = event.passed_states(), event.suppressed_states()
        decides = any(isinstance(node, nodes.If | nodes.Select) for node in nodes.walk(event.function.body))
        happened = [state for way, state in event.exits.items() if way.fate in PASSES and way.happened]
        dropped = all(way.fate == DROPPED for way in event.exits if way.fate not in PASSES)
        if suppressed and not happened and decides and dropped and not _drops_by_word(event.function):
            text = f"{quote(event.code.name)} drops every message, because each path ends with `return;`, which drops"
            advice = "it; leave out the `return;` of the path that passes"
            yield Diagnostic(event.code.position, "warning", f"{text} {advice}")
        kept = frozenset[int]().union(*(state.written for state in passed))
        names = {
            code: one.variable.name for one in event.bound if one.variable for code in (one.variable.code,)
        }
        flags = {flag: names.get(variable, "") for flag, variable in event.fields.items()}
        for way, state in event.exits.items():
            if way.fate in PASSES:
                continue
            how, word = ("drops", "return;") if way.fate == DROPPED else ("replaces", "STOP;")
            for site in sorted(state.written - kept):
                name = next(
                    (flags[flag] for flag in self._flags_at(event.function, site) if flag in flags), ""
                )
                text = f"the new value of {quote(name)} is lost, because this path {how} the message"
                yield Diagnostic(
                    self._sites[site].position,
                    "warning",
                    f"{text}; to send the changed message, leave out the `{word}`",
                )
        yield from self._stale(event)

    def _flags_at(self, function: nodes.Function, site: int) -> Iterator[str]:
        for node in nodes.walk(function.body):
            if isinstance(node, nodes.Evaluate) and node.site == site:
                for inner in nodes.walk(node.value):
                    if isinstance(inner, nodes.Assign):
                        yield inner.name

    def _stale(self, event: _Event) -> Iterator[Diagnostic]:
        """Warn of a silent `return` that leaves the state, by which other topics are judged, as it was."""
        judged_by = frozenset[str]().union(
            *(self._decides(other) for other in self.events if other.channel not in (event.channel, None))
        )
        happened = [state for way, state in event.exits.items() if way.fate in PASSES and way.happened]
        updated = {
            name for state in happened for name in state.values if is_shared(name) and name in judged_by
        }
        for way, state in event.exits.items():
            if (
                way.fate != DROPPED
                or state.spoke
                or not updated
                or any(name in state.values for name in updated)
            ):
                continue
            site = min(event.drops, default=None)
            name = self._variables.get(min(updated), "")
            if site is not None and name:
                text = f"this `return;` drops the message and leaves {quote(name)} as it was, so other topics are"
                text += f" judged by an older message; set {quote(name)} before, or let the message pass"
                yield Diagnostic(self._sites[site].position, "warning", text)

    def _decides(self, event: _Event) -> frozenset[str]:
        """Return the inputs on which drops and assigned fields of an event depend."""
        found = frozenset[str]().union(*event.drops.values())
        for state in event.exits.values():
            for flag, variable in event.fields.items():
                if state.values.get(flag, AbstractValue(False)).known is not False:
                    found |= state.values.get(variable, AbstractValue()).inputs | state.values[flag].inputs
        return found

    def _idle_returns(self) -> Iterator[Diagnostic]:
        """Warn of a `return` at the end of a function, handler or timer whose condition decides nothing."""
        places = [(one.code, "function", "return a `bool` and drop in the action") for one in self._helpers]
        handlers = [name for code in self.code.properties for name in code.handlers.values()]
        places += [(name, "handler", "write `DROP;`") for name in handlers]
        timers = [event.code.function for event in self.events if event.code.period_ns is not None]
        places += [(name, "timer", "write `STOP;`") for name in timers]
        for name, what, advice in places:
            function = self._forms[name]
            for site in _tail_returns(function.body) if self._only_prints(function) else ():
                text = f"this `return;` only ends the {what}, and drops no message; {advice}"
                yield Diagnostic(self._sites[site].position, "warning", text)

    def _only_prints(self, function: nodes.Function) -> bool:
        reached, waiting = {function.name}, [function]
        while waiting:
            each = waiting.pop()
            if each.shared:
                return False
            for node in nodes.walk(each.body):
                if isinstance(node, nodes.Drop | nodes.StopMessage | nodes.Publish | nodes.Reset) or (
                    isinstance(node, nodes.Call) and nodes.acts(node)
                ):
                    return False
                if isinstance(node, nodes.Invoke) and node.function not in reached:
                    reached.add(node.function)
                    waiting.append(self._forms[node.function])
        return True

    # Acceleration limits

    def limits(self) -> Iterator[tuple[_Event, str]]:
        """Yield the events that remember a command, by which later commands are limited, and the variables."""
        for event in self.events:
            if event.code.topic is None or event.code.part is not None:
                continue
            on_topic = [one for one in self.events if one.channel == event.channel]
            deciding = frozenset[str]().union(*map(self._decides, on_topic))
            numbers = {f"field {path}" for one in event.bound for path, _ in self._leaves(one)} | {"message"}
            if not any(one.fields for one in on_topic):
                continue  # it limits no field
            numbers |= {f"whole {_path_of(one)}" for one in event.bound}
            elsewhere = {
                name
                for one in self.events
                if one.channel != event.channel
                for state in one.exits.values()
                for name in state.values
            }  # such a specification knows of stops
            for name in sorted(deciding & self._variables.keys() - elsewhere):
                remembered = any(
                    name in state.values and not numbers.isdisjoint(state.values[name].inputs)
                    for state in event.passed_states()
                )
                if remembered:
                    yield event, name

    def _early_limits(self) -> Iterator[Diagnostic]:
        """Warn of limits whose memory outlives a stop in the same specification."""
        for event, name in self.limits():
            who = next(self._forgetful(event, name), "")
            if who:
                what = quote(self._variables[name])
                text = f"{what} remembers a command by which later ones are limited, but {who} may stop or drop that"
                text += (
                    f" command: the next one is limited as if the robot had driven on; also set {what} there"
                )
                yield Diagnostic(event.code.position, "warning", text)

    def _forgetful(self, event: _Event, name: str) -> Iterator[str]:
        """Yield what may stop or drop a command that the variable remembers, without a change of the variable."""
        for other in self.events[self.events.index(event) + 1 :]:
            stopped = other.suppressed_states() if other.channel == event.channel else []
            if any(name not in state.values for state in stopped):
                yield quote(other.code.name)
        for code in self.code.properties:
            handlers = (self._forms[handler] for handler in code.handlers.values())
            if any(_suppresses(handler) and name not in handler.shared for handler in handlers):
                yield "a handler"

    def may_suppress(self, topic: str) -> bool:
        """Whether it may stop or drop messages of a topic."""
        events = [event for event in self.events if event.code.topic == topic and event.code.part is None]
        stops = any(safe.topic == topic for safe in self.code.safes) and any(
            event.sent_states() for event in self.events
        )
        handlers = [self._forms[name] for code in self.code.properties for name in code.handlers.values()]
        handled = bool(events) and any(map(_suppresses, handlers))
        return stops or handled or any(event.suppressed_states() for event in events)

    def name_of(self, variable: str) -> str:
        return quote(self._variables[variable])


def flow_findings(shared: CompilationContext, compiled: Sequence[SpecificationCode]) -> list[Diagnostic]:
    """Follow each specification; one that is too large is a warning, and so is a defect of this analysis."""
    found, flows = list[Diagnostic](), list[SpecificationFlow]()
    left = MAX_WORK_OF_SET
    for code in compiled:
        work = FlowWork(min(left, MAX_WORK))
        left -= work.left
        try:
            flow = SpecificationFlow(shared, code, work)
            found += flow.findings()
        except (FlowLimitError, RecursionError):
            text = f"NaN, `return` and limits are not checked in {code.name}, because it is too large"
            found.append(Diagnostic(code.position, "warning", text))
        except Exception as error:  # noqa: BLE001  a guard is loaded in spite of a defect of a lint
            text = (
                f"NaN, `return` and limits are not checked in {code.name}; the check has a defect: {error!r}"
            )
            found.append(Diagnostic(code.position, "warning", text))
        else:
            flows.append(flow)
        left += max(work.left, 0)
    return [*found, *_limits_before_stops(flows)]


def _limits_before_stops(flows: Sequence[SpecificationFlow]) -> Iterator[Diagnostic]:
    for place, flow in enumerate(flows):
        seen = set[str]()
        for event, name in flow.limits():
            if flow.may_suppress(event.code.topic or ""):
                continue  # it knows of stops itself
            for later in flows[place + 1 :]:
                stop = later.code.name
                if stop in seen or not later.may_suppress(event.code.topic or ""):
                    continue
                seen.add(stop)
                text = f"{flow.code.name} limits commands by the last one ({flow.name_of(name)}), and {stop}, which may"
                text += " stop or drop it, comes later: then the robot jumps, as if it had driven on; write"
                yield Diagnostic(event.code.position, "warning", f"{text} `order {stop} < {flow.code.name};`")


def _tail_returns(body: Sequence[nodes.Statement]) -> Iterator[int]:
    """Yield the sites of returns in branches behind which nothing follows."""
    rest = [*body]
    while rest and isinstance(rest[-1], nodes.Return | nodes.Leave):
        rest.pop()
    if rest and isinstance(rest[-1], nodes.If):
        for branch in (rest[-1].yes, rest[-1].no):
            if branch and isinstance(branch[-1], nodes.Return | nodes.Leave):
                yield branch[-1].site
            else:
                yield from _tail_returns(branch)


def _batches(events: Sequence[_Event]) -> Iterator[Sequence[_Event]]:
    """Yield the events of each channel, and each timer."""
    for channel, group in groupby(sorted(events, key=_channel), _channel):
        same = [*group]
        yield from [same] if channel else [[one] for one in same]


def _channel(event: _Event) -> str:
    return event.channel or ""


def _written_fields(event: _Event, state: PathState) -> list[tuple[str, AbstractValue]]:
    """Return the variables of fields that may have been assigned, and their values."""
    return [
        (variable, state.values.get(variable, AbstractValue()))
        for flag, variable in event.fields.items()
        if state.values.get(flag, AbstractValue(False)).known is not False
    ]


def _suppresses(function: nodes.Function) -> bool:
    return any(isinstance(node, nodes.Drop | nodes.StopMessage) for node in nodes.walk(function.body))


def _drops_by_word(function: nodes.Function) -> bool:
    """Whether a path drops by `DROP;`, which C++ does not have, so that it is on purpose."""
    body = [*nodes.walk(function.body)]
    leaving = {node.site for node in body if isinstance(node, nodes.Leave)}
    return any(isinstance(node, nodes.Drop) and node.site not in leaving for node in body)


def _path_of(one: PatternField) -> str:
    return ".".join(
        step.name if step.index is None else f"{step.name}[{step.index}]" for step in one.binding.path
    )


def _has_nan(value: AbstractValue) -> bool:
    if isinstance(value.known, AbstractParts):
        return any(_has_nan(one) for one in (*value.known.parts.values(), value.known.others))
    return value.is_nan or value.may_be_nan or any(kind in _MIN_MAX for kind, _ in value.why)


def _badly(value: AbstractValue) -> Places:
    """Return the places of a value that is sent, and that NaN let through."""
    if isinstance(value.known, AbstractParts):
        return frozenset().union(*map(_badly, (*value.known.parts.values(), value.known.others)))
    if value.is_nan or value.may_be_nan:
        return value.why
    least = frozenset(place for place in value.why if place[0] in _MIN_MAX)
    if value.known is UNKNOWN:
        return frozenset(place for place in value.why if place[0] != TEST)
    return least if value.is_number and value.known != 0 else frozenset()


def _tainted_variables(values: Mapping[str, AbstractValue]) -> dict[str, AbstractValue]:
    """Return the variables in which NaN has left a trace, with the numbers that are known beside them, or nothing."""
    kept = {name: value for name, value in values.items() if value.is_number or is_tainted(value)}
    return kept if any(map(is_tainted, kept.values())) else {}


def _text(kind: str, name: str) -> str:
    of, what = (f" of {quote(name)}", f"NaN in {quote(name)}") if name else ("", "NaN (of 0 / 0 or a root)")
    if kind == COMPARISON:
        text = f"NaN passes this bound{of}, because each comparison with NaN is false; use `clamp`,"
        return f"{text} negate the opposite comparison (`!(x <= 1)`), or use `isnan`"
    if kind in _MIN_MAX:
        where = f" in {quote(name)}" if name else ""
        return f"`{kind}` passes NaN{where} on, or takes it for the other bound; test it with `isnan` before"
    if kind == TEST:
        return f"{what} passes, because this test lets it pass; negate the opposite (`!(x <= 1)`), or stop it"
    if kind == CAST:
        return f"{what} becomes 0 in this conversion, and passes; test it with `isnan` before"
    assert kind == CALL  # the last kind
    return f"{what} has a fixed result in this function, and passes; test it with `isnan` before"
