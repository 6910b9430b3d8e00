"""Measure how often recordings exercise events, branches, handlers, functions, states and transitions.

A counter is added before each action, branch and handler in the syntax tree, not in the text, so line numbers stay
the same. The runs of state machines are observed from outside.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

from rosmop.check.sources import compiled_from
from rosmop.check.specification import compile_files
from rosmop.form.findings import Position, SpecificationError
from rosmop.learn.recordings import RecordingSource
from rosmop.logics.catalogue import LOGICS
from rosmop.logics.fsm import FAIL, TIMEOUT, StateText, read_state_machine
from rosmop.logics.interface import Categories, CompiledProperty, FormulaError, Run, Source
from rosmop.run.engine import MonitorSet
from rosmop.run.explain import history_of
from rosmop.run.outcomes import MessageSender
from rosmop.text import tree
from rosmop.text.parser import parse
from roswire.definitions import Definitions


@dataclass(frozen=True)
class CoverageItem:
    """A part that a recording may exercise (`event`, `branch`, `state`, …)."""

    specification: str
    kind: str
    what: str
    position: Position


def items_of(texts: Mapping[str, str]) -> list[CoverageItem]:
    """Return the items in their order. Raises `SpecificationError`."""
    try:
        return _items(_mark(texts))
    except FormulaError as error:
        raise SpecificationError(error.findings) from error


def coverage(texts: Mapping[str, str], definitions: Definitions, recording: RecordingSource) -> list[int]:
    """Return the counts in the order of `items_of`. Raises `SpecificationError`.

    A state counts the events that entered it or stayed in it.
    """
    compiled_from(texts, definitions)  # reports errors for the unchanged text
    marked = _mark(texts)
    counts: Counter[CoverageItem] = Counter()
    monitors = MonitorSet(compile_files(marked.files, definitions), "drop", lambda: lambda: False)
    # explaining a verdict makes test runs, which are not part of the recording
    monitors.explain_when(lambda *_: False, lambda *_: False)
    watches = _watch(monitors)
    monitors.name_senders(lambda _source: ("", recording.caller))
    monitors.start(recording.began, frozenset(recording.topics))
    for number, (topic, time, data) in enumerate(recording.messages(), 1):
        monitors.process(topic, data, time, MessageSender(number))
    monitors.advance(recording.ended)
    for monitor in monitors.monitors:
        for name, item in marked.items.items():
            if item.specification == monitor.name:
                counts[item] += monitors.value(monitor.name, name)
    for watch in watches:
        counts.update(watch.counts())
    return [counts[item] for item in _items(marked)]


def add_counts(one: Sequence[int], other: Sequence[int]) -> list[int]:
    return [a + b for a, b in zip(one, other, strict=True)]


def _mark(texts: Mapping[str, str]) -> "_Marked":
    return _Marked([parse(text, name) for name, text in texts.items()])


def _items(marked: "_Marked") -> list[CoverageItem]:
    items = [*marked.items.values(), *(item for file in marked.files for item in _machine_items(file))]
    return sorted(dict.fromkeys(items), key=lambda item: item.position)


# Counters in the tree


class _Marked:
    def __init__(self, files: Sequence[tree.SpecificationFile]) -> None:
        self.items: dict[str, CoverageItem] = {}
        self._declared: list[tree.Declaration] = []
        self._specification = ""
        self.files = [
            replace(
                file,
                specifications=tuple(self._marked(specification) for specification in file.specifications),
            )
            for file in files
        ]

    def _marked(self, node: tree.Specification) -> tree.Specification:
        self._specification, self._declared = node.name, []
        events = tuple(
            replace(event, action=self._block("event", event.name, event.position, event.action))
            for event in node.events
        )
        functions = tuple(
            replace(function, body=self._block("function", function.name, function.position, function.body))
            for function in node.functions
        )
        inits = tuple(
            replace(block, body=self._block("function", "init", block.position, block.body))
            for block in node.inits
        )
        properties = tuple(
            replace(
                declared,
                handlers=tuple(
                    replace(
                        handler,
                        body=self._block("handler", f"@{handler.category}", handler.position, handler.body),
                    )
                    for handler in declared.handlers
                ),
            )
            for declared in node.properties
        )
        return replace(
            node, declarations=(*node.declarations, *self._declared), events=events, functions=functions, inits=inits,
            properties=properties,
        )  # fmt: skip

    def _block(self, kind: str, what: str, position: Position, body: tree.Statement) -> tree.Block:
        mark = self._mark(CoverageItem(self._specification, kind, what, position))
        inside = self._inside(body)
        statements = inside.statements if isinstance(inside, tree.Block) else (inside,)
        return tree.Block(body.position, (mark, *statements))

    def _mark(self, item: CoverageItem) -> tree.Statement:
        name = f"covered_{len(self.items)}_"
        self.items[name] = item
        text = f"m() {{ static long {name} = 0; init() {{ {name} = {name} + 1; }} }}"
        (specification,) = parse(text, item.position.file).specifications
        self._declared += specification.declarations
        return specification.inits[0].body.statements[0]

    def _inside(self, node: tree.Statement) -> tree.Statement:
        if isinstance(node, tree.Block):
            return replace(node, statements=tuple(self._inside(statement) for statement in node.statements))
        if isinstance(node, tree.IfStatement):
            yes = self._block("branch", "if", node.position, node.yes)
            no = node.no or tree.Block(node.position, ())
            if isinstance(no, tree.IfStatement):  # its own branches are marked
                return replace(node, yes=yes, no=self._inside(no))
            return replace(node, yes=yes, no=self._block("branch", "else", no.position, no))
        if isinstance(node, tree.WhileStatement | tree.ForStatement | tree.RangeForStatement):
            return replace(node, body=self._block("branch", "loop", node.position, node.body))
        if isinstance(node, tree.SwitchStatement):
            cases = tuple(
                replace(
                    case,
                    statements=(
                        self._mark(CoverageItem(self._specification, "branch", "case", case.position)),
                        *(self._inside(statement) for statement in case.statements),
                    ),
                )
                for case in node.cases
            )
            return replace(node, cases=cases)
        return node


# State machines


def _watch(monitors: MonitorSet) -> list["_Watch"]:
    watches = []
    for monitor in monitors.monitors:
        for running in monitor.properties:
            if LOGICS[running.code.property.logic].has_states:
                watch = _Watch(monitor.name, running.code.property)
                running.code = replace(running.code, property=watch)
                running.history = history_of(watch, 0)
                watches.append(watch)
    return watches


class _Watch(CompiledProperty):
    def __init__(self, specification: str, machine: CompiledProperty) -> None:
        super().__init__(machine.source, machine.categories)
        self.expiry = machine.expiry
        self.taken: Counter[tuple[str, str]] = Counter()
        self._machine = machine
        self._specification = specification
        self.timed = machine.timed

    def start(self, time_ns: int) -> Run:
        states = read_state_machine(self.source, timed=self._machine.timed).states
        return _Run(self, self._machine.start(time_ns), next(iter(states)))

    def counts(self) -> dict[CoverageItem, int]:
        counts: Counter[CoverageItem] = Counter()
        states = read_state_machine(self.source, timed=self.timed).states
        for (state, event), count in self.taken.items():
            if state in states:
                target = _target(states[state], event)
                counts[_transition(self._specification, self.source, state, event, states[state])] += count
                if target in states:
                    counts[_state(self._specification, self.source, target)] += count
        return dict(counts)


class _Run:
    def __init__(self, watch: _Watch, run: Run, state: str) -> None:
        self._watch = watch
        self._run = run
        self._state = state

    def __copy__(self) -> "_Run":
        return _Run(self._watch, copy(self._run), self._state)

    @property
    def deadline(self) -> int | None:
        return self._run.deadline

    @property
    def as_new(self) -> bool:
        """Return False, so that no watched run is stepped as a test."""
        return False

    def step(self, event: int, time_ns: int) -> Categories:
        categories = self._run.step(event, time_ns)
        self._watch.taken[self._state, self._watch.events[event]] += 1
        self._state = categories[0]
        return categories

    def expire(self) -> Categories:
        categories = self._run.expire()
        self._watch.taken[self._state, TIMEOUT] += 1
        self._state = categories[1] if len(categories) > 1 else self._state
        return categories

    def save(self) -> tuple[()]:
        return ()

    def restore(self, saved: tuple[()]) -> None: ...


def _target(state: StateText, event: str) -> str:
    if event == TIMEOUT:
        return state.timeout[1].text if state.timeout is not None else FAIL
    move = state.moves.get(event, state.default)
    return move.text if move is not None else FAIL


def _state(specification: str, source: Source, name: str) -> CoverageItem:
    match = re.search(rf"\b{name}\s*\[", source.text)
    return CoverageItem(
        specification, "state", name, source.origin.within(source.text, match.start() if match else 0)
    )


def _transition(specification: str, source: Source, state: str, event: str, text: StateText) -> CoverageItem:
    written = event if event in text.moves or event == TIMEOUT else "default"
    target = _target(text, event)
    token = text.timeout[1] if event == TIMEOUT and text.timeout else text.moves.get(event, text.default)
    position = source.origin.within(source.text, token.offset) if token is not None else source.origin
    what = f"{state}: {written} -> {target}" if token is not None else f"{state}: any other event -> {FAIL}"
    return CoverageItem(specification, "transition", what, position)


def _machine_items(file: tree.SpecificationFile) -> Iterator[CoverageItem]:
    for node in file.specifications:
        names = tuple(event.name for event in node.events)
        for declared in node.properties:
            logic = declared.logic.lower()
            if LOGICS[logic].has_states:
                source = Source(
                    logic, declared.formula, names, declared.formula_position, times=dict(declared.times)
                )
                for name, state in read_state_machine(source, timed=logic == "tfsm").states.items():
                    yield _state(node.name, source, name)
                    for event in state.moves:
                        yield _transition(node.name, source, name, event, state)
                    if state.default is not None:
                        yield _transition(node.name, source, name, "default", state)
                    if state.timeout is not None:
                        yield _transition(node.name, source, name, TIMEOUT, state)
