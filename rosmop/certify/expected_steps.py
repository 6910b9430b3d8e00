"""Compute the effect that a walk must have on messages: that of `run/execution.py`, over certified automata."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rosmop.fast.abi import LEFT, SOONER, TOLD
from rosmop.fast.batch_codegen import WasmModule
from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import SpecificationGroup
from rosmop.logics.interface import ClockedProperty, ClockedRun, CompiledProperty, FiniteProperty

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
        self.properties = {one.number: one for rows in self.steps for one in rows if one.number is not None}
        self._begun = {
            number: begun_in(one, _initial(one.compiled)) for number, one in self.properties.items()
        }
        self.clocked = any(isinstance(one.compiled, ClockedProperty) for one in self.properties.values())

    def begun(self) -> States:
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
        self, one: PropertyStep, states: States, case: StepCase, frame: int, result: ExpectedResult
    ) -> bool:
        if one.number is None:
            raise LeftToEngineError
        if isinstance(one.compiled, ClockedProperty):
            run = ClockedRun(one.compiled, 0)
            run.state, run.since, run.now = states[one.number]
            categories = run.step(one.event, case.now)
            states[one.number] = run.state, run.since, run.now
            deadline = run.deadline
            result.sooner |= deadline is not None and deadline < case.until
            if any(handled.category in categories for handled in one.handlers):
                raise LeftToEngineError
            return False
        assert isinstance(one.compiled, FiniteProperty)  # noqa: S101  a property with a number has tables
        automaton = one.compiled.automaton
        state = states[one.number] = automaton.table[states[one.number]][one.event]
        run_now = [handled for handled in one.handlers if handled.category in automaton.verdicts[state]]
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
            states[one.number] = automaton.initial
        return bool(bits & DROPPED)


def _initial(property_: CompiledProperty) -> int:
    assert isinstance(property_, FiniteProperty | ClockedProperty)  # noqa: S101  a property with a number has tables
    return property_.automaton.initial if isinstance(property_, FiniteProperty) else property_.initial


def begun_in(one: PropertyStep, state: int) -> Any:
    return state if isinstance(one.compiled, FiniteProperty) else (state, BEGAN, BEGAN)


def _drops(compiled: Compiled, function: str) -> bool:
    return any(isinstance(node, nodes.Drop) for node in nodes.walk(compiled.functions[function]))
