"""Run the steps of a compiled module in every state, and compare them with the certified automata.

A *walk* of a module (`fast/batch_codegen.py`) calls the functions of events, looks up states in tables, and
runs handlers. The check runs the same bytes with stubs for these functions (`scripted_module.py`), and
compares the effect with that of the walk, below:

- each event alone, in every state of every property; with a clock before, at and after its bound;
- each handler with no result, a drop, `__RESET;`, both, and a message that is left to the engine;
- each event that may drop, with a drop; two events on one message in every state, with a drop by the second, up to
`MAX` steps; and several messages in one read, all with the same results;
- a monitor that is switched off, and a drop and a verdict that are left to the engine.

Not checked: the functions themselves (see `prove`), the list of effects after a changed message, the stored
explanations, and the translation to machine code. Addresses are taken from the code generator, and the steps
of clocked properties from `ClockedRun`.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from rosmop.certify.scripted_module import NOTE, RECORD, SCRIPT, TELL, to_script
from rosmop.fast.abi import AREA, LEFT, SOONER, TOLD, Cells
from rosmop.fast.batch_codegen import WasmModule
from rosmop.fast.wasm_instance import WasmInstance, WasmTrap, translate
from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import SpecificationGroup, groups
from rosmop.logics.interface import ClockedProperty, ClockedRun, CompiledProperty, FiniteProperty

# Compute the effect that a walk must have on messages: that of `run/execution.py`, over certified automata.

HAPPENED, DROPPED, CHANGED, ELSEWHERE, RESET = 1, 2, 4, 8, 16
NEVER, BEGAN = (1 << 63) - 1, 1_000

States = dict[int, Any]


@dataclass(frozen=True)
class StepCase:
    """The input of a walk: the result of each function, and the fields of `BatchOptions`."""

    script: Mapping[int, int]
    now: int = BEGAN
    frames: int = 1
    told: int = 0
    enabled: int = -1
    counted: int = -1
    until: int = NEVER
    beside: tuple[int, int] | None = None


@dataclass
class ExpectedResult:
    states: States
    position: int = 0
    effects: list[tuple[int, int]] = field(default_factory=list)
    calls: list[tuple[int, int]] = field(default_factory=list)
    happened: list[int] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)
    verdicts: list[int] = field(default_factory=list)
    left: bool = False
    sooner: bool = False

    @property
    def answer(self) -> int:
        flags = TOLD * bool(self.verdicts) | SOONER * self.sooner | LEFT * self.left
        return len(self.effects) << 32 | flags


class LeftToEngineError(Exception):
    """The walk leaves the message to the engine."""


@dataclass(frozen=True)
class ExpectedHandler:
    """A handler; its verdict is None if it is not compiled."""

    category: str
    verdict: int | None
    function: int
    drops: bool


@dataclass(frozen=True)
class PropertyStep:
    """A property that an event steps; its number is None if the module does not have it."""

    number: int | None
    compiled: CompiledProperty
    event: int
    handlers: Sequence[ExpectedHandler]

    @property
    def states(self) -> int:
        tables = self.compiled
        assert isinstance(tables, FiniteProperty | ClockedProperty)  # noqa: S101  a property with a number has tables
        return len(tables.automaton) if isinstance(tables, FiniteProperty) else len(tables.verdicts)


class ExpectedTopic:
    """The events of a topic and their properties, as specified."""

    def __init__(
        self,
        compiled: Compiled,
        group: SpecificationGroup,
        module: WasmModule,
        topic: str,
        numbers: Sequence[tuple[int, int]],
    ) -> None:
        feed = module.feeds[topic]
        self.functions = feed.functions
        met = list(dict.fromkeys(number for number, _ in numbers))
        self.specifications = [met.index(number) for number, _ in numbers]
        codes = [compiled.specifications[number].events[index] for number, index in numbers]
        self.drops = [_drops(compiled, code.function) for code in codes]
        places = {each: place for place, each in enumerate(group.properties)}
        known: dict[tuple[int, int, int], tuple[int | None, int]] = {
            (numbers[event][0], place, handler): (verdict, module.handlers[topic][verdict])
            for verdict, (event, place, handler) in enumerate(feed.verdicts)
        }
        self.steps: list[list[PropertyStep]] = []
        for number, index in numbers:
            rows = []
            for place, code in enumerate(compiled.specifications[number].properties):
                handled = [
                    ExpectedHandler(category, verdict, function, _drops(compiled, code.handlers[category]))
                    for handler, category in enumerate(code.order)
                    for verdict, function in [known.get((number, place, handler), (None, -1))]
                ]
                rows.append(PropertyStep(places.get((number, place)), code.property, index, handled))
            self.steps.append(rows)
        self.properties = {row.number: row for rows in self.steps for row in rows if row.number is not None}
        self._begun = {
            number: begun_in(one, _initial(one.compiled)) for number, one in self.properties.items()
        }
        self.clocked = any(isinstance(one.compiled, ClockedProperty) for one in self.properties.values())

    def initial_states(self) -> States:
        return dict(self._begun)

    def walk(self, states: States, case: StepCase) -> ExpectedResult:
        result = ExpectedResult(states)
        for frame in range(case.frames):
            before = len(result.happened), len(result.dropped), len(result.verdicts)
            try:
                after = self._message(dict(result.states), case, frame, result)
            except LeftToEngineError:
                for done, kept in zip(
                    (result.happened, result.dropped, result.verdicts), before, strict=True
                ):
                    del done[kept:]
                result.left, result.sooner = True, False
                return result
            result.states, result.position = after, frame + 1
            if len(result.dropped) > before[1]:
                if result.effects and result.effects[-1][1] == frame:
                    frame, _ = result.effects.pop()  # noqa: PLW2901  consecutive drops are one effect
                result.effects.append((frame, result.position))
            if result.sooner:
                break
        return result

    def _message(self, states: States, case: StepCase, frame: int, result: ExpectedResult) -> States:
        before = dict(states)
        for event, function in enumerate(self.functions):
            if not case.enabled >> self.specifications[event] & 1:
                continue
            result.calls.append((function, frame))
            bits = case.script.get(function, 0)
            if bits & ELSEWHERE:
                raise LeftToEngineError
            if bits & HAPPENED:
                result.happened.append(event)
            gone = bool(bits & DROPPED)
            for one in () if gone or not bits & HAPPENED else self.steps[event]:
                gone |= self._step(one, states, case, frame, result)
            if gone:
                if case.told >> event & 1:
                    raise LeftToEngineError
                result.dropped.append(event)
                return {number: self._taken_back(number, before[number], states[number]) for number in states}
        return states

    def _taken_back(self, number: int, before: Any, after: Any) -> Any:
        if not self.properties[number].compiled.suppresses:
            return after
        return before if isinstance(before, int) else (*before[:2], after[2])

    def _step(
        self, step: PropertyStep, states: States, case: StepCase, frame: int, result: ExpectedResult
    ) -> bool:
        if step.number is None:
            raise LeftToEngineError
        if isinstance(step.compiled, ClockedProperty):
            run = ClockedRun(step.compiled, 0)
            run.state, run.since, run.now = states[step.number]
            categories = run.step(step.event, case.now)
            states[step.number] = run.state, run.since, run.now
            deadline = run.deadline
            result.sooner |= deadline is not None and deadline < case.until
            if any(handled.category in categories for handled in step.handlers):
                raise LeftToEngineError
            return False
        assert isinstance(step.compiled, FiniteProperty)  # noqa: S101  a property with a number has tables
        automaton = step.compiled.automaton
        state = states[step.number] = automaton.table[states[step.number]][step.event]
        run_now = [handled for handled in step.handlers if handled.category in automaton.verdicts[state]]
        if any(each.verdict is None or not case.counted >> each.verdict & 1 for each in run_now):
            raise LeftToEngineError
        bits = 0
        for handled in run_now:
            result.calls.append((handled.function, frame))
            bits |= case.script.get(handled.function, 0)
            if bits & ELSEWHERE:
                raise LeftToEngineError
            result.verdicts.append(handled.verdict or 0)
        if bits & RESET:
            states[step.number] = automaton.initial
        return bool(bits & DROPPED)


def _initial(property_: CompiledProperty) -> int:
    assert isinstance(property_, FiniteProperty | ClockedProperty)  # noqa: S101  a property with a number has tables
    return property_.automaton.initial if isinstance(property_, FiniteProperty) else property_.initial


def begun_in(step: PropertyStep, state: int) -> Any:
    return state if isinstance(step.compiled, FiniteProperty) else (state, BEGAN, BEGAN)


def _drops(compiled: Compiled, function: str) -> bool:
    return any(isinstance(node, nodes.Drop) for node in nodes.walk(compiled.functions[function]))


MAX = 100_000

_FEW = 16  # the number of states to try if the state does not matter
_FUEL = 100_000  # for each message
_FRAME = bytes(range(7, 23))


class StepDiffersError(Exception):
    """The steps of the module differ from the automaton; the message says where."""


def check_steps(compiled: Compiled, module: WasmModule) -> int:
    if not module.feeds:
        return 0
    pairs = MAX
    machine = WasmInstance(translate(to_script(module), module.memory), module.memory)
    benches = []
    for group, cells in zip(groups(compiled.specifications), module.cells, strict=True):
        for (name, _), numbers in zip(group.component.topics, group.events, strict=True):
            if name in module.feeds:
                topic = ExpectedTopic(compiled, group, module, name, numbers)
                benches.append((topic, _Bench(machine, module, cells, topic, name)))
    steps = sum(
        bench.run(case, number, everywhere=everywhere)
        for topic, bench in benches
        for case, number, everywhere in _cases(topic)
    )
    for topic, bench in benches:
        for case, number, everywhere in _pairs(topic):
            if pairs <= 0:
                return steps
            done = bench.run(case, number, everywhere=everywhere)
            pairs, steps = pairs - done, steps + done
    return steps


def _cases(topic: ExpectedTopic) -> Iterator[tuple[StepCase, int | None, bool]]:
    for event, function in enumerate(topic.functions):
        happens = {function: HAPPENED}
        rows = [one for one in topic.steps[event] if one.number is not None]
        yield StepCase({}), None, False
        yield StepCase({function: ELSEWHERE}), None, False
        for row in rows:
            for now in _times(row):
                yield StepCase(happens, now), row.number, True
            for other in rows:
                beside = _handling(other) if other is not row else None
                if beside is not None:
                    dropping = happens | _answers(other, DROPPED)
                    yield StepCase(dropping, beside=beside), row.number, True
                    yield StepCase(happens | _answers(row, DROPPED), beside=beside), row.number, True
            yield StepCase(happens, until=BEGAN), row.number, True
            yield StepCase(happens, frames=3), row.number, True
            yield StepCase(happens, counted=0), row.number, True
            for bits in (DROPPED, RESET, DROPPED | RESET, ELSEWHERE) if row.handlers else ():
                script = happens | _answers(row, bits)
                yield StepCase(script), row.number, True
                if bits == DROPPED:
                    yield StepCase(script, frames=3), row.number, True
                    yield StepCase(script, told=1 << event), row.number, True
        yield StepCase(happens), None, False
        if topic.drops[event]:
            for number in (None, *topic.properties):
                yield StepCase({function: HAPPENED | DROPPED}), number, False
            yield StepCase({function: HAPPENED | DROPPED}, frames=3), None, False
            yield StepCase({function: HAPPENED | DROPPED}, told=1 << event), None, False
    for place in dict.fromkeys(topic.specifications):
        yield StepCase(dict.fromkeys(topic.functions, HAPPENED), enabled=~(1 << place)), None, False


def _pairs(topic: ExpectedTopic) -> Iterator[tuple[StepCase, int | None, bool]]:
    for first, second in combinations(range(len(topic.functions)), 2):
        one, other = topic.functions[first], topic.functions[second]
        numbers = dict.fromkeys(each.number for event in (first, second) for each in topic.steps[event])
        happen = {one: HAPPENED, other: HAPPENED}
        for number in numbers or (None,):
            yield StepCase(happen), number, True
            if topic.drops[second]:
                yield StepCase(happen | {other: HAPPENED | DROPPED}), number, True
            if topic.drops[first]:
                yield StepCase(happen | {one: HAPPENED | DROPPED}), number, True
            answers: dict[int, int] = {}
            for each in topic.steps[second]:
                answers |= _answers(each, DROPPED)
            if any(answers.values()):
                yield StepCase(happen | answers), number, True


def _handling(step: PropertyStep) -> tuple[int, int] | None:
    if step.number is None or not isinstance(step.compiled, FiniteProperty):
        return None
    handled, automaton = {handler.category for handler in step.handlers}, step.compiled.automaton
    for state, targets in enumerate(automaton.table):
        if not handled.isdisjoint(automaton.verdicts[targets[step.event]]):
            return step.number, state
    return None


def _answers(step: PropertyStep, bits: int) -> dict[int, int]:
    bits |= HAPPENED | CHANGED
    return {
        handler.function: bits if handler.drops else bits & ~DROPPED
        for handler in step.handlers
        if handler.verdict is not None
    }


def _times(step: PropertyStep) -> Sequence[int]:
    if isinstance(step.compiled, FiniteProperty):
        return (BEGAN,)
    within = step.compiled.within  # type: ignore[attr-defined]  # it has a clock
    return BEGAN - 5, BEGAN, BEGAN + within, BEGAN + within + 1


class _Bench:
    def __init__(
        self, machine: WasmInstance, module: WasmModule, cells: Cells, topic: ExpectedTopic, name: str
    ) -> None:
        feed = module.feeds[name]
        self._memory, self._cells, self._feed, self._topic = machine.memory, cells, feed, topic
        self._machine, self._name = machine, name
        self._try = machine.function(f"try {feed.name}")
        self._frames = module.frames
        self._functions, self._nothing = module.functions, bytes(4 * module.functions)
        template = self._frames + SCRIPT + 4 * self._functions
        self._template = template + -template % 8
        self._out = self._template + 8 * (cells.properties + 1)
        self._scratch = self._out - 8
        room = module.frames + AREA - self._out
        size = RECORD.size + 3 * NOTE.size * (len(topic.functions) + sum(map(len, topic.steps)) * 9)
        self._most = 1 if topic.clocked else max(1, room // size)
        for frame in range(3):
            at = self._frames + 20 * frame
            self._memory[at : at + 20] = struct.pack("<I", len(_FRAME)) + _FRAME

    def run(self, case: StepCase, number: int | None, *, everywhere: bool) -> int:
        one = None if number is None else self._topic.properties[number]
        states = 1 if one is None else one.states if everywhere else min(one.states, _FEW)
        for first in range(0, states, self._most):
            self._sweep(case, one, first, min(first + self._most, states))
        return states

    def _sweep(self, case: StepCase, step: PropertyStep | None, first: int, behind: int) -> None:
        begun = self._topic.initial_states()
        if case.beside is not None:
            begun[case.beside[0]] = case.beside[1]
        if step is not None and self._topic.clocked:
            begun[step.number or 0] = begun_in(step, first)
        if any(self._waits_no_more(number, state, case) for number, state in begun.items()):
            return
        notes = self._out + RECORD.size * (behind - first)
        self._put_down(case, begun, notes)
        cell = self._scratch if step is None else self._cells.base + 8 * (step.number or 0)
        self._machine.refuel(_FUEL * (behind - first) * case.frames)
        end = self._frames + 20 * case.frames
        try:
            self._try(first, behind, cell, self._out, end, case.now)
        except WasmTrap as trap:
            self._differs(case, step, first, f"it stopped: {trap}")
        expected = []
        at = notes
        for place, state in enumerate(range(first, behind)):
            if step is not None and not self._topic.clocked:
                begun[step.number or 0] = state
            expected.append(self._topic.walk(dict(begun), case))
            answer = *RECORD.unpack_from(self._memory, self._out + RECORD.size * place), at
            at = self._compare(case, step, state, answer, expected[-1])
        self._count(case, step, expected)

    def _waits_no_more(self, number: int, state: Any, case: StepCase) -> bool:
        tables = self._topic.properties[number].compiled
        if not isinstance(tables, ClockedProperty) or tables.waits[state[0]] is None:
            return False
        run = ClockedRun(tables, 0)
        run.state, run.since, run.now = state
        return case.now > (run.deadline or 0)

    def _put_down(self, case: StepCase, states: States, notes: int) -> None:
        memory, cells, feed = self._memory, self._cells, self._feed
        for number in range(cells.properties):
            state = states.get(number, 0)
            shown = state if isinstance(state, int) else state[0]
            struct.pack_into("<q", memory, self._template + 8 * number, shown)
            if number in cells.clocks and not isinstance(state, int):
                struct.pack_into("<2q", memory, cells.clocks[number], *state[1:])
        script = self._frames + SCRIPT
        memory[script : script + 4 * self._functions] = self._nothing
        for function, bits in case.script.items():
            struct.pack_into("<i", memory, script + 4 * function, bits)
        told = self._frames + TELL
        struct.pack_into("<I", memory, told, notes)
        struct.pack_into("<3I", memory, told + 16, cells.base, self._template, 8 * cells.properties)
        struct.pack_into("<4q", memory, cells.source, 5 << 32, case.told, case.enabled, case.counted)
        struct.pack_into("<q", memory, cells.until, case.until)
        counters = 2 * len(feed.functions) + len(feed.verdicts)
        memory[feed.counters : feed.counters + 8 * counters] = bytes(8 * counters)

    def _compare(
        self,
        case: StepCase,
        step: PropertyStep | None,
        state: int,
        given: tuple[int, ...],
        expected: ExpectedResult,
    ) -> int:
        answer, who, what, cell, end, at = given
        notes = list(NOTE.iter_unpack(self._memory[at:end]))
        begins = [self._frames + 20 * frame for frame in range(4)]
        wanted = [(function, begins[frame] + 4, len(_FRAME)) for function, frame in expected.calls]
        effect = [(-1, begins[begin] | begins[behind] << 32) for begin, behind in expected.effects[:1]]
        after: Any = None if step is None else expected.states[step.number or 0]
        number = after if after is None or isinstance(after, int) else after[0]
        clock = self._clock(step) if step is not None and self._topic.clocked else ()
        for found, right, what_of in (
            (answer, expected.answer | begins[expected.position], "its result"),
            (notes, wanted, "the functions it calls, in order"),
            ([(who, what)] if effect else [], effect, "the messages it drops"),
            (None if step is None else cell, number, "the next state"),
            (clock, after[1:] if clock else (), "the clock"),
        ):
            if found != right:
                self._differs(case, step, state, f"{what_of}: {found}, not {right}")
        return int(end)

    def _clock(self, step: PropertyStep) -> tuple[int, ...]:
        address = self._cells.clocks.get(step.number or 0)
        return () if address is None else struct.unpack_from("<2q", self._memory, address)

    def _count(self, case: StepCase, step: PropertyStep | None, expected: Sequence[ExpectedResult]) -> None:
        rows = [
            [0] * len(self._feed.functions),
            [0] * len(self._feed.functions),
            [0] * len(self._feed.verdicts),
        ]
        for each in expected:
            for row_of, places in zip(rows, (each.happened, each.dropped, each.verdicts), strict=True):
                for place in places:
                    row_of[place] += 1
        wanted = tuple(count for row_of in rows for count in row_of)
        found = struct.unpack_from(f"<{len(wanted)}q", self._memory, self._feed.counters)
        if found != wanted:
            self._differs(case, step, 0, f"its counters: {found}, not {wanted}")

    def _differs(self, case: StepCase, one: PropertyStep | None, state: int, text: str) -> None:
        formula = "" if one is None else f", `{one.compiled.logic}: {one.compiled.formula}` in state {state}"
        raise StepDiffersError(f"{self._name}{formula}: {text} ({case})")
