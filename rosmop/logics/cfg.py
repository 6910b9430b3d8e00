"""``cfg``: context-free grammars over the events, as MOP's CFG plugin reads them.

If the recogniser has few states, as for a regular language, the grammar becomes a table.
"""

from rosmop.logics.automaton import Automaton, TooManyStatesError, explore
from rosmop.logics.cfg_grammar import Grammar, prepare, read_grammar
from rosmop.logics.ere import with_fail
from rosmop.logics.interface import (
    Categories,
    CompiledProperty,
    CostlyRun,
    FiniteProperty,
    Run,
    Source,
    UntimedRun,
)
from rosmop.logics.parsing import EarleyRecogniser, EarleySet

CATEGORIES: Categories = ("match", "fail")
MATCH: Categories = ("match",)
FAIL: Categories = ("fail",)
UNDECIDED: Categories = ()

MAX_TABLE_FRAMES = 500


class GrammarProperty(CompiledProperty):
    """A property for a grammar that needs a stack."""

    def __init__(self, source: Source, grammar: Grammar) -> None:
        super().__init__(source, CATEGORIES)
        self.recogniser = EarleyRecogniser(grammar)

    def start(self, _time_ns: int) -> Run:
        return GrammarRun(self.recogniser)


class GrammarRun(UntimedRun, CostlyRun):
    """A run of a grammar; the frame is None after a failure."""

    __slots__ = ("_recogniser", "frame")

    def __init__(self, recogniser: EarleyRecogniser) -> None:
        self._recogniser = recogniser
        self.frame: EarleySet | None = recogniser.initial

    @property
    def work(self) -> int:  # type: ignore[override]  # no step comes between this one and the question
        return self._recogniser.work

    def step(self, event: int, _time_ns: int) -> Categories:
        if self.frame is None:
            return FAIL
        after = self._recogniser.step(self.frame, event)
        if after is None:
            self.frame = None
            return FAIL
        self.frame, accepted = after
        return MATCH if accepted else UNDECIDED

    def save(self) -> tuple[EarleySet | None]:
        return (self.frame,)

    def restore(self, saved: tuple[EarleySet | None]) -> None:
        (self.frame,) = saved


def compile_cfg(source: Source) -> CompiledProperty:
    grammar = prepare(read_grammar(source))
    automaton = _table(EarleyRecogniser(grammar), len(source.events))
    if automaton is not None:
        return FiniteProperty(source, CATEGORIES, with_fail(automaton))
    return GrammarProperty(source, grammar)


def _table(recogniser: EarleyRecogniser, events: int) -> Automaton | None:
    frames: dict[object, EarleySet] = {}

    def held(frame: EarleySet) -> object:
        return (frame.shape, tuple(None if cont is None else (id(cont[0]), cont[1]) for cont in frame.conts))

    def same(frame: EarleySet) -> EarleySet:
        return frames.setdefault(held(frame), frame)

    def step(state: tuple[EarleySet | None, bool], event: int) -> tuple[EarleySet | None, bool]:
        after = None if state[0] is None else recogniser.step(state[0], event)
        if after is None:
            return None, False
        if not after[0].shape.kept:
            raise TooManyStatesError(MAX_TABLE_FRAMES)
        return same(after[0]), after[1]

    try:
        initial: tuple[EarleySet | None, bool] = (same(recogniser.initial), False)
        return explore(
            initial, events, step, lambda state: MATCH if state[1] else UNDECIDED, MAX_TABLE_FRAMES
        )
    except TooManyStatesError:
        return None
