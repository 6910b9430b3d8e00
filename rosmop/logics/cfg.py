"""``cfg``: context-free grammars over the events, as MOP's CFG plugin reads them.

``S -> a S b | epsilon``; the first left side starts. Any grammar is accepted, ambiguous and nullable ones
too. The category is ``match`` while the trace so far is in the language, ``fail`` once no continuation can
be.

A grammar whose recogniser has few states (because its language is regular and it says so plainly) becomes a
table.
"""

from rosmop.logics.automaton import Automaton, TooManyStatesError, explore
from rosmop.logics.cfg_grammar import Grammar, prepare, read_grammar
from rosmop.logics.ere import with_fail
from rosmop.logics.interface import (
    Categories,
    CompiledProperty,
    FiniteProperty,
    Run,
    Source,
    UntimedRun,
    twin,
)
from rosmop.logics.parsing import Frame, Recogniser

CATEGORIES: Categories = ("match", "fail")
MATCH: Categories = ("match",)
FAIL: Categories = ("fail",)
UNDECIDED: Categories = ()

MAX_TABLE_FRAMES = 500
"""Up to how many frames are looked at to find a finite table."""


class GrammarProperty(CompiledProperty):
    """A grammar that needs a stack."""

    def __init__(self, source: Source, grammar: Grammar) -> None:
        super().__init__(source, CATEGORIES)
        self.recogniser = Recogniser(grammar)

    def start(self, _time_ns: int) -> Run:
        """A fresh run; the time plays no part."""
        return GrammarRun(self.recogniser)


class GrammarRun(UntimedRun):
    """A run: the current frame, or None after a failure."""

    __slots__ = ("_step", "frame")
    keeps = ("frame",)
    __copy__ = twin

    def __init__(self, recogniser: Recogniser) -> None:
        self._step = recogniser.step
        self.frame: Frame | None = recogniser.initial

    def step(self, event: int, _time_ns: int) -> Categories:
        """Take the event; the time plays no part. Raises RunFaultError, and is unchanged then."""
        if self.frame is None:
            return FAIL
        after = self._step(self.frame, event)
        if after is None:
            self.frame = None
            return FAIL
        self.frame, accepted = after
        return MATCH if accepted else UNDECIDED


def compile_cfg(source: Source) -> CompiledProperty:
    """Compile a ``cfg`` formula. Raises FormulaError."""
    grammar = prepare(read_grammar(source))
    automaton = _table(Recogniser(grammar), len(source.events))
    if automaton is not None:
        return FiniteProperty(source, CATEGORIES, with_fail(automaton))
    return GrammarProperty(source, grammar)


def _table(recogniser: Recogniser, events: int) -> Automaton | None:
    """The recogniser as an automaton, if the frames it can reach are few. Frames are compared by what they
    hold."""
    frames: dict[object, Frame] = {}

    def held(frame: Frame) -> object:
        return (frame.shape, tuple(None if cont is None else (id(cont[0]), cont[1]) for cont in frame.conts))

    def same(frame: Frame) -> Frame:
        return frames.setdefault(held(frame), frame)

    def step(state: tuple[Frame | None, bool], event: int) -> tuple[Frame | None, bool]:
        after = None if state[0] is None else recogniser.step(state[0], event)
        if after is None:
            return None, False
        if not after[0].shape.kept:
            raise TooManyStatesError(MAX_TABLE_FRAMES)
        return same(after[0]), after[1]

    try:
        initial: tuple[Frame | None, bool] = (same(recogniser.initial), False)
        return explore(
            initial,
            events,
            step,
            lambda state: MATCH if state[1] else UNDECIDED,
            MAX_TABLE_FRAMES,
        )
    except TooManyStatesError:
        return None
