"""Outcomes of messages, ticks and deadlines: as values, as data (records, the CLI, REST), and as text.

Data about causes are limited in size. `who` names the source of a message.
"""

import datetime
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple

from rosmop.form.findings import Position
from rosmop.form.sites import Site, showing
from rosmop.logics import mtl, ptcaret, ptltl
from rosmop.logics.formula import Bounds, Formula, Syntax, nodes, read_formula
from rosmop.logics.interface import Source
from rosmop.runtime.action_context import LogLine
from rosmop.runtime.action_context import Published as Published  # noqa: PLC0414  the appliance imports it from here
from rosmop.runtime.wire import Buffer
from rosmop.types.value_types import Value

# Find the subformulas that decide a past-time formula over the events of an explanation.
#
# These are few events, so the formula is evaluated by its definition, position by position.

_SYNTAXES: dict[str, Syntax] = {"ptltl": ptltl.SYNTAX, "mtl": mtl.SYNTAX, "ptcaret": ptcaret.SYNTAX}
_BOOLEAN: dict[str, Callable[[list[bool]], bool]] = {
    "true": lambda _: True,
    "false": lambda _: False,
    "not": lambda values: not values[0],
    "and": all,
    "or": any,
    "xor": lambda values: sum(values) % 2 == 1,
    "implies": lambda values: not values[0] or values[1],
    "iff": lambda values: values[0] == values[1],
}
_MAX_EVENTS = 24
_MAX = 8


def deciding(source: Source, events: Sequence[int], times: Sequence[int]) -> list[str]:
    """Return the subformulas, or none for other logics and for formulas about the future.

    `events` are numbers in the source, and `times` are in nanoseconds.
    """
    syntax = _SYNTAXES.get(source.logic)
    if syntax is None or not 0 < len(events) <= _MAX_EVENTS:
        return []
    formula = read_formula(source, syntax)
    if any(node.operator in mtl.FUTURE for node in nodes(formula)):
        return []
    words = _Words(syntax)
    meaning = Meaning([source.events[event] for event in events], times)
    last = len(events) - 1
    found = [
        f"{words.text(part)} is {str(value).lower()}" for part, value in _decisive(meaning, formula, last)
    ]
    return list(dict.fromkeys(found))[:_MAX]


def _decisive(meaning: "Meaning", formula: Formula, at: int) -> Iterator[tuple[Formula, bool]]:
    value, operator = meaning.holds(formula, at), formula.operator
    if operator == "not":
        yield from _decisive(meaning, formula.operands[0], at)
    elif operator in ("and", "or", "implies", "xor", "iff"):
        # a true operand decides `or`, a false one `and`; otherwise all decide
        wanted = [
            meaning.holds(part, at) != (operator == "implies" and not number)
            for number, part in enumerate(formula.operands)
        ]
        alone = (operator == "and" and not value) or (operator in ("or", "implies") and value)
        for part, is_so in zip(formula.operands, wanted, strict=True):
            if not alone or is_so == value:
                yield from _decisive(meaning, part, at)
    elif operator not in ("true", "false"):
        yield formula, value


class Meaning:
    """Evaluates formulas at the positions of a trace."""

    def __init__(self, events: Sequence[str], times: Sequence[int]) -> None:
        self._events = events
        self._times = times
        self._abstract = [self._seen(at) for at in range(len(events))]
        self._known: dict[tuple[int, int], bool] = {}
        self._plain: dict[int, Formula] = {}

    def holds(self, formula: Formula, at: int) -> bool:
        key = id(formula), at
        if key not in self._known:
            self._known[key] = self._value(formula, at)
        return self._known[key]

    def _seen(self, at: int) -> list[int]:
        seen: list[int] = []
        for place, event in enumerate(self._events[:at]):
            seen.append(place)
            if event == ptcaret.END:
                open_calls = [
                    number for number, earlier in enumerate(seen) if self._events[earlier] == ptcaret.BEGIN
                ]
                seen = seen[: open_calls[-1]] if open_calls else []
        return [*seen, at]

    def _value(self, formula: Formula, at: int) -> bool:
        operator, operands = formula.operator, formula.operands
        if operator == "event":
            return self._events[at] == formula.name
        if operator in _BOOLEAN:
            return _BOOLEAN[operator]([self.holds(operand, at) for operand in operands])
        if operator.partition(" ")[0] in ("at", "some", "every"):
            return self.holds(self._plain.setdefault(id(formula), ptcaret.plain(formula)), at)
        abstract, dual = operator.startswith("abstract "), operator.startswith("dual ")
        places = self._abstract[at] if abstract else list(range(at + 1))
        return self._past(
            operator.removeprefix("abstract ").removeprefix("dual "), formula, places, dual=dual
        )

    def _past(self, operator: str, formula: Formula, places: list[int], *, dual: bool) -> bool:
        low, high = formula.bounds or (0, None)
        *first, last = formula.operands
        now = self._times[places[-1]]

        def near(place: int) -> bool:
            return now - self._times[place] >= low and (high is None or now - self._times[place] <= high)

        def right(place: int) -> bool:
            return self.holds(last, place) != dual

        if operator == "previously":
            return (len(places) > 1 and near(places[-2]) and right(places[-2])) != dual
        if operator == "historically":
            return all(right(place) for place in places if near(place))
        for place in reversed(places):
            if near(place) and right(place):
                return not dual
            if first and self.holds(first[0], place) == dual:
                break
        return dual


class _Words:
    def __init__(self, syntax: Syntax) -> None:
        levels = [syntax.unary, *(level.operators for level in syntax.levels)]
        self._spelled = {meant: word for words in levels for word, meant in reversed([*words.items()])}

    def text(self, formula: Formula) -> str:
        if not formula.operands:
            return formula.name or formula.operator
        parts = [
            f"({self.text(operand)})" if len(operand.operands) > 1 else self.text(operand)
            for operand in formula.operands
        ]
        word = self._spelled[formula.operator] + _bounds(formula.bounds)
        return f"{word} {parts[0]}" if len(parts) == 1 else f" {word} ".join(parts)


def _bounds(bounds: Bounds | None) -> str:
    if bounds is None:
        return ""
    low, high = bounds
    return f"[{_duration(low)},{'inf' if high is None else _duration(high)}]"


def _duration(nanoseconds: int) -> str:
    for unit, size in (("s", 10**9), ("ms", 10**6), ("us", 10**3)):
        if nanoseconds and not nanoseconds % size:
            return f"{nanoseconds // size}{unit}"
    return f"{nanoseconds}ns"


_EACH_END = 5

Result = Literal["passed", "changed", "dropped"]

SHADOW_BUDGET = 100_000
"""The instructions for one message, some tens of milliseconds, for which other messages wait."""

FUEL_PER_SECOND = 1_500_000_000

DROPPED = -1
"""The key of the drop in `Outcome.handling`."""


class MessageSender(NamedTuple):
    """The source of a message (chosen by the caller; 0: none), and a sequence number of the given `kind`.

    The message is `altered` if another set has changed or published it.
    """

    source: int = 0
    number: int = 0
    kind: int = 0
    altered: bool = False


Who = Callable[[int], Mapping[str, object]]

NOBODY = MessageSender()
NO_NUMBER, SEQ = range(2)


class EventOccurrence(NamedTuple):
    """An event that happened; `event` is its number in the specification, `state` the state after it, if any."""

    event: int
    time: int
    sender: MessageSender
    state: str = ""


class Explanation(NamedTuple):
    """Events that alone give a verdict. They are the `fewest` if none of them can be left out.

    With `since` (ns), the events lead to the verdict from the property's state at that time.
    """

    events: tuple[EventOccurrence, ...]
    fewest: bool = True
    since: int | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """A property's arrival in a category that has a handler.

    `property` counts from 0 in its specification; `source` is its formula. `why` is None if an explanation was not
    wanted (`MonitorSet.explain_when`) or is impossible. `binding` has the values of parameters by name.
    """

    monitor: str
    property: int
    logic: str
    category: str
    source: Source
    why: Explanation | None = None
    binding: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Fault:
    """A runtime error that stopped an action, with the `values` of the variables involved.

    If it `outdates`, the monitor's state may be out of date, because an event that it observes did not take
    effect. `malformed`: the bytes were not a message of the event's type. `over`: the message exceeded its budget,
    which is a limit of the monitor and says nothing about the sender.
    """

    monitor: str
    position: Position
    text: str
    values: Mapping[str, object]
    outdates: bool = False
    malformed: bool = False
    over: bool = False


def label_of(verdict: Verdict) -> str:
    name = f"property {verdict.property + 1} of {verdict.monitor} ({verdict.logic}){binding(verdict)}"
    return f"{name}: {verdict.category}"


def binding(verdict: Verdict) -> str:
    if not verdict.binding:
        return ""
    return f" with {', '.join(f'{name} = {value}' for name, value in verdict.binding.items())}"


class Outcome:
    """The result of a message, tick or deadline."""

    result: Result = "passed"
    timer: str | None = None
    """The source of a tick or deadline: `specification.tick`, `.timeout`, `.deadline` or `.safe`."""
    events: Sequence[str] = ()
    """Named `specification.event`."""
    verdicts: Sequence[Verdict] = ()
    published: Sequence[Published] = ()
    log: Sequence[LogLine] = ()
    faults: Sequence[Fault] = ()
    before: Sequence["Outcome"] = ()
    """The outcomes of ticks and deadlines that were due before this message."""
    shadowed: Sequence["Outcome"] = ()
    """When a set starts, the outcomes of its sets in shadow mode."""
    reason: str | None = None
    """Why the message was dropped without an event: the topic is held, or the start failed."""
    changed_by: Sequence[str] = ()
    """In order, the events whose actions changed bytes of the message."""
    changed_at: Sequence[Position] = ()
    """The positions of the statements that changed bytes."""
    dropped_by: str = ""
    """The specification that dropped the message: at its last event, after a fault (`fatal`), or for `reason`."""
    fatal: Fault | None = None
    dropped_at: Position | None = None
    """The position of the statement, the action or the specification."""
    handling: Mapping[int, Verdict] = MappingProxyType({})
    """The verdicts whose handlers dropped the message (key `DROPPED`) or published messages (keys: their indices)."""
    looked: Mapping[int, tuple[Value, ...]] = MappingProxyType({})
    """The conditions that were met, by site, with the values that they compared.

    They are each `when` of an event that happened, and each `if` around a statement that dropped, changed or
    published a message.
    """
    began_holding: Sequence[str] = ()
    """The monitors that a fault made hold their topics."""
    doubtful: Sequence[str] = ()
    """The monitors that begin again, because they await the message of another node, or a readable one of it."""
    judged: Mapping[int, "Outcome"] = MappingProxyType({})
    """The outcomes of published messages in the monitors after their publisher, by index."""
    sites: Sequence[Site] = ()
    overwritten: Sequence[tuple[int, bytes]] = ()
    """For a dropped message, the original bytes that actions overwrote (position and bytes, in order)."""
    repeated: bool = False
    """Whether this only repeats a safe message, and so needs no report."""

    def __init__(self, buffer: Buffer = b"", time: int = 0) -> None:
        self.buffer = buffer
        """The message to relay: the buffer that came in (changed in place where possible), or another buffer."""
        self.time = time

    def restore(self, buffer: memoryview) -> None:
        if not buffer.readonly:
            for start, old in reversed(self.overwritten):
                buffer[start : start + len(old)] = old

    def sent_messages(self) -> Iterator[Published]:
        """Yield published messages as they go out: changed by later monitors, and without those that were dropped.

        Calls of services are included; their requests go through the monitors when they are sent.
        """
        for number, message in enumerate(self.published):
            judged = self.judged.get(number)
            if judged is None:
                yield message
            elif judged.result != "dropped":
                yield message._replace(data=bytes(judged.buffer))

    @property
    def conditions(self) -> dict[str, dict[str, object]]:
        return {
            str(site.position): {
                each.name: showing(each.type)(value)
                for each, value in zip(site.compared, values, strict=True)
            }
            for site, values in ((self.sites[number], values) for number, values in self.looked.items())
        }

    def __repr__(self) -> str:
        told = {name: value for name, value in vars(self).items() if name != "buffer"}
        return f"Outcome({self.result}, {told})"


class Margin(NamedTuple):
    """How close a comparison came to changing its result; `holds`: while it was true.

    `number` counts the monitor's comparisons in the order of the text. `threshold` is the constant side, 0 or 1.
    """

    monitor: str
    number: int
    position: Position
    threshold: int | None
    holds: bool
    left: float
    right: float

    @property
    def distance(self) -> float:
        return abs(self.left - self.right)

    @property
    def threshold_at(self) -> float | None:
        return None if self.threshold is None else (self.right, self.left)[self.threshold]


def of_drop(outcome: Outcome, who: Who) -> dict[str, object]:
    return {
        **({"at": [str(outcome.dropped_at)]} if outcome.dropped_at is not None else {}),
        **({"values": dict(outcome.fatal.values)} if outcome.fatal is not None else {}),
        **_led(outcome, who, outcome.handling.get(DROPPED)),
    }


def of_change(outcome: Outcome, who: Who) -> dict[str, object]:
    return {
        "changed_by": list(outcome.changed_by),
        "at": [str(position) for position in outcome.changed_at],
        **_led(outcome, who),
    }


def of_published(outcome: Outcome, number: int, who: Who) -> dict[str, object]:
    message = outcome.published[number]
    position = outcome.sites[message.site].position
    return {"type": message.type, "at": [str(position)], **_led(outcome, who, outcome.handling.get(number))}


def of_fault(outcome: Outcome, fault: Fault, who: Who) -> dict[str, object]:
    where = fault.position
    return {
        "file": where.file,
        "line": where.line,
        "column": where.column,
        "text": fault.text,
        "values": dict(fault.values),
        "at": [str(where)],
        **_led(outcome, who),
    }


def of_verdict(outcome: Outcome, verdict: Verdict, who: Who) -> dict[str, object]:
    return {
        "property": verdict.property,
        "logic": verdict.logic,
        "category": verdict.category,
        **({"binding": dict(verdict.binding)} if verdict.binding else {}),
        "at": [str(verdict.source.origin)],
        **_led(outcome, who),
        **why_of(verdict, who),
    }


def _led(outcome: Outcome, who: Who, handled: Verdict | None = None) -> dict[str, object]:
    return {
        "events": list(outcome.events),
        **({"timer": outcome.timer} if outcome.timer is not None else {}),
        **({"conditions": outcome.conditions} if outcome.looked else {}),
        **({"handler": label_of(handled), **why_of(handled, who)} if handled is not None else {}),
    }


def why_of(verdict: Verdict, who: Who) -> dict[str, dict[str, object]]:
    why = verdict.why
    if why is None:
        return {}
    events = [_event(verdict, event, who) for event in why.events]
    between = len(events) - 2 * _EACH_END
    said: dict[str, object] = {"events": events}
    if between > 0:
        said = {"events": [*events[:_EACH_END], *events[-_EACH_END:]], "left_out": between}
    said["fewest"] = why.fewest
    if why.since is not None:
        said["since"] = moment(why.since)
    decided = decided_by(verdict.source, why)
    if decided:
        said["decided"] = decided
    return {"why": said}


def moment(time_ns: int) -> str:
    return datetime.datetime.fromtimestamp(time_ns / 1e9, datetime.UTC).isoformat(timespec="microseconds")


def _event(verdict: Verdict, happened: EventOccurrence, who: Who) -> dict[str, object]:
    event: dict[str, object] = {"event": verdict.source.events[happened.event], "time": moment(happened.time)}
    event |= {"state": happened.state} if happened.state else {}
    event |= who(happened.sender.source) if happened.sender.source else {}
    return event | ({"seq": happened.sender.number} if happened.sender.kind == SEQ else {})


def decided_by(source: Source, why: Explanation) -> list[str]:
    if why.since is not None:
        return []
    return deciding(source, [event.event for event in why.events], [event.time for event in why.events])
