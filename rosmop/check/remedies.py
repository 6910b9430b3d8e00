"""Check what `enforced by` claims: the due message is published, accepted, and suppressed by no later specification.

The function, the pattern and `when` of the awaited event, and the events of later specifications are run. The parts
that depend on a state are compared at each deadline instead (`run/execution.py`), and `check` says so.
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal

import msgspec

from rosmop.check.enforcement import place_of_remedy
from rosmop.check.scope import CompilationContext
from rosmop.form import nodes
from rosmop.form.compiled import EventCode, PropertyCode, RemedyCode, SpecificationCode
from rosmop.form.findings import Diagnostic
from rosmop.logics.property_lint import TIME, VerdictGraph, graph_of
from rosmop.run.interpreter import Interpreter
from rosmop.runtime.wire import WireMessage
from rosmop.types.messages import quote

_CHANGING = (nodes.Now, nodes.SenderName, nodes.Altered)


class _UnansweredError(Exception):
    """No due message comes, for the reason in the text."""


def with_remedies_checked(
    shared: CompilationContext, compiled: Sequence[SpecificationCode]
) -> list[SpecificationCode]:
    """Describe the remedies of a set; a remedy whose message certainly does not come is an error."""
    if not any(code.remedy for one in compiled for code in one.properties):
        return [*compiled]
    trial = _Trial(shared, compiled)
    return [
        replace(one, properties=tuple(trial.describe(place, code) for code in one.properties))
        for place, one in enumerate(compiled)
    ]


class _Trial:
    def __init__(self, shared: CompilationContext, compiled: Sequence[SpecificationCode]) -> None:
        self._shared, self._compiled = shared, compiled
        self._forms = shared.functions
        contexts = {one.context: one.name for one in compiled}
        self._interpreter = Interpreter(
            shared.functions, shared.symbols.sites, shared.variables.types, contexts, shared.messages
        )
        self._interpreter.variables |= {given.code: given.default for one in compiled for given in one.givens}
        start = {name for one in compiled for name in one.start}
        self._changing = {given.code for one in compiled for given in one.givens}
        self._changing |= {code for one in compiled if one.slicing for _, code, _ in one.slicing.parameters}
        variables = {code for one in compiled for code in one.variables.values()}
        for name, function in self._forms.items():
            if name not in start:
                self._changing.update(function.shared, variables.intersection(_changed_parts(function)))

    def describe(self, place: int, code: PropertyCode) -> PropertyCode:
        if code.remedy is None:
            return code
        specification, remedy = self._compiled[place], code.remedy
        event = specification.events[remedy.event]
        try:
            open_question = self._open(place, specification, remedy, event)
        except _UnansweredError as error:
            self._shared.findings.append(Diagnostic(place_of_remedy(code.property), "error", str(error)))
            return code
        said = f"enforced: at the deadline {remedy.name} publishes the due message ({event.topic})"
        if open_question:
            said = (
                f"enforced, or @violation: at the deadline {remedy.name} is called to publish the due message"
                f" ({event.topic}), and it is compared whether {open_question}"
            )
        return replace(code, enforcement=said)

    def _open(
        self, place: int, specification: SpecificationCode, remedy: RemedyCode, event: EventCode
    ) -> str:
        """Return what depends on the state, or nothing. Raises `_UnansweredError` if no due message comes."""
        awaited, topic = quote(event.name), event.topic or ""
        if not self._is_fixed(remedy.function):
            return f"{awaited} accepts it, and no later monitor suppresses it"
        self._begin()
        messages = self._published(remedy, topic)
        if not messages:
            text = f"{quote(remedy.name)} publishes no message on {topic}, where {awaited} is due"
            raise _UnansweredError(f"{text}; publish it on each path")
        if not self._is_fixed(remedy.accepts):
            return f"{awaited} accepts it, and no later monitor suppresses it"
        messages = [data for data in messages if self._accepts(remedy, topic, data)]
        if not messages:
            text = f"{awaited} does not accept the message that {quote(remedy.name)} publishes on {topic}"
            raise _UnansweredError(f"{text}: its pattern or its `when` does not fit; publish one that fits")
        first = place if specification.ordered else place + 1
        for later in self._compiled[first:]:
            left = [self._passed(later, topic, data) for data in messages]
            if any(one is None for one in left):
                return f"{later.name} lets the message pass"
            messages = [data for data in left if data is not None and data is not False]
            if not messages:
                text = f"{later.name} drops the message that {quote(remedy.name)} publishes on {topic}"
                advice = f"; let {later.name} come first: `order {later.name} < {specification.name};`"
                raise _UnansweredError(text if later is specification else text + advice)
            if not any(self._accepts(remedy, topic, data) for data in messages):
                text = (
                    f"the message that {quote(remedy.name)} publishes on {topic} is changed by {later.name}"
                )
                raise _UnansweredError(
                    f"{text}, so that {awaited} no longer accepts it; change their order, or one of them"
                )
        return ""

    def _passed(self, later: SpecificationCode, topic: str, data: bytes) -> bytes | Literal[False] | None:
        """Return the message behind a specification, False if it is dropped, or None if that depends on the state."""
        message = WireMessage(bytearray(data), 0, topic)
        undecided = False
        for number, event in enumerate(later.events):
            if event.topic != topic or event.part is not None:
                continue
            if later.slicing is not None or not self._is_fixed(event.function):
                return None
            try:
                happened = self._interpreter.function(event.function)(message)
            except Exception:  # noqa: BLE001  a fault drops the message, unless the appliance passes faults
                return None
            if message.dropped:
                return False
            if happened and message.stopped is None:
                for code in later.properties:
                    drops = self._drops(code, number, topic, data)
                    if drops:
                        return False
                    undecided = undecided or drops is None
            message.stopped = None
        return None if undecided else bytes(message.buffer)

    def _drops(self, code: PropertyCode, event: int, topic: str, data: bytes) -> bool | None:
        """Whether the handlers of a property drop a message that is this event in every state, or None: in some."""
        may = {
            category
            for category, name in code.handlers.items()
            if any(isinstance(node, nodes.Drop | nodes.StopMessage) for node in self._reached(name))
        }
        if not may:
            return False
        graph = graph_of(code.property)
        if graph is None:
            return None
        must = {category for category in may if self._handler_drops(code.handlers[category], topic, data)}
        name = code.property.events[event]
        found = [
            not must.isdisjoint(graph.verdicts[target])
            for state in _passing(graph, must if code.property.suppresses else ())
            for trace, target in graph.edges[state]
            if trace[-1] == name
        ]
        if all(found):
            return True
        possible = any(
            not may.isdisjoint(graph.verdicts[target])
            for edges in graph.edges
            for trace, target in edges
            if trace[-1] == name
        )
        return None if possible else False

    def _handler_drops(self, name: str, topic: str, data: bytes) -> bool:
        if not self._is_fixed(name):
            return False
        message = WireMessage(bytearray(data), 0, topic)
        try:
            self._interpreter.function(name)(message)
        except Exception:  # noqa: BLE001  whether a fault drops is configured
            return False
        return message.dropped

    def _begin(self) -> None:
        for stage in range(3):
            for one in self._compiled:
                with suppress(Exception):  # a specification that faults at its start judges nothing
                    self._interpreter.function(one.start[stage])()

    def _published(self, remedy: RemedyCode, topic: str) -> list[bytes]:
        turn = self._interpreter.turn
        turn.published.clear()
        with suppress(Exception):  # messages before the fault are published
            self._interpreter.function(remedy.function)()
        return [one.data for one in turn.published if one.topic == topic and not one.is_call]

    def _accepts(self, remedy: RemedyCode, topic: str, data: bytes) -> bool:
        try:
            return bool(self._interpreter.function(remedy.accepts)(WireMessage(data, 0, topic)))
        except Exception:  # noqa: BLE001  an event that faults has not happened
            return False

    # Dependence on the state

    def _is_fixed(self, name: str) -> bool:
        """Whether the effect on messages is the same in every state. Output and mere counters do not matter."""
        reads, kept = set[str](), list[tuple[str, set[str]]]()
        for function in self._functions(name):
            waiting: list[object] = [function.body]
            while waiting:
                node = waiting.pop()
                if isinstance(node, _CHANGING):
                    return False
                if isinstance(node, nodes.Log):
                    continue
                if isinstance(node, nodes.Evaluate) and isinstance(node.value, nodes.Assign):
                    assigned = node.value
                    inner = list(nodes.walk(assigned.value))
                    if not nodes.acts(assigned.value) and not any(
                        isinstance(one, _CHANGING) for one in inner
                    ):
                        sources = {one.name for one in inner if isinstance(one, nodes.Read)}
                        kept.append((assigned.name, sources))
                        continue
                if isinstance(node, nodes.Read):
                    reads.add(node.name)
                if isinstance(node, tuple):
                    waiting += node
                elif isinstance(node, msgspec.Struct):
                    waiting += msgspec.structs.astuple(node)
        grown = True
        while grown:
            grown = False
            for target, sources in kept:
                if target in reads and not sources <= reads:
                    reads |= sources
                    grown = True
        return reads.isdisjoint(self._changing)

    def _functions(self, name: str) -> list[nodes.Function]:
        found = {name: self._forms[name]}
        waiting = [name]
        while waiting:
            for node in nodes.walk(self._forms[waiting.pop()]):
                if isinstance(node, nodes.Invoke) and node.function not in found:
                    found[node.function] = self._forms[node.function]
                    waiting.append(node.function)
        return [*found.values()]

    def _reached(self, name: str) -> Iterator[object]:
        for function in self._functions(name):
            yield from nodes.walk(function)


def _changed_parts(function: nodes.Function) -> Iterator[str]:
    """Yield the variables in whose elements or fields the function assigns."""
    for node in nodes.walk(function):
        if isinstance(node, nodes.Call) and node.arguments and nodes.acts(node):
            place: nodes.Expression | None = node.arguments[0]
            while place is not None and not isinstance(place, nodes.Read):
                match place:
                    case nodes.Item(base=base) | nodes.Call(arguments=(base, *_)):
                        place = base
                    case _:
                        place = None
            if place is not None:
                yield place.name


def _passing(graph: VerdictGraph, dropping: Collection[str]) -> set[int]:
    """Return the states that messages reach which these categories do not drop."""
    found, waiting = {graph.initial}, [graph.initial]
    while waiting:
        for trace, target in graph.edges[waiting.pop()]:
            stays = trace[-1] != TIME and not set(dropping).isdisjoint(graph.verdicts[target])
            if target not in found and not stays:
                found.add(target)
                waiting.append(target)
    return found
