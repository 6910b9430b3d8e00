"""Ask z3 about one event: costly operations on numbers get their meaning only if the answer depends on it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import z3

from rosmop.prove.concrete_runs import READS_BEYOND
from rosmop.prove.terms import Abstraction, DiffersError, Term, either

_TOGETHER = 20_000_000
"""The effort of z3, in its own unit, for all conditions at once: a few seconds, and a fifth of the time at most."""


class MayDifferError(Exception):
    """The induction over the iterations of a loop fails for a state that may not occur."""


class Questions:
    """Asks z3 about one event, up to the time `until`. The conditions `known` hold."""

    def __init__(self, clock: Callable[[], float], until: float, known: Sequence[Term]) -> None:
        self._clock, self._until, self._known = clock, until, known
        self._abstractions = Abstraction(floats=True), Abstraction()

    def exclude(self, conditions: Iterable[Term]) -> bool:
        """Whether none of the conditions can hold, whatever operations on floats calculate."""
        question = [*self._known, either(*map(z3.simplify, conditions))]
        answer, _ = self._asked(self._abstractions[0].of(question), effort=_TOGETHER)
        return bool(answer == z3.unsat)

    def decide(self, condition: Term, replay: Callable[[Any], None] = lambda _: None) -> tuple[Any, Any]:
        """Return whether the condition is satisfiable, and a model. Formulas without costly operations are tried
        first. `replay` gets each model, also of such a formula.
        """
        question, guess = [*self._known, condition], None
        for abstraction in self._abstractions:
            answer, guess = self._asked(abstraction.of(question))
            if answer == z3.unsat:
                return answer, None
        if guess is not None:
            replay(guess)
            if _holds(question, guess):
                return z3.sat, guess
        answer, model = self._asked(question)
        if model is not None:
            replay(model)
        return answer, model

    def _asked(self, conditions: Sequence[Term], *, effort: int = 0) -> tuple[Any, Any]:
        """Return whether the conditions are satisfiable, and a model, within the time that is left."""
        rest = int(1000 * (self._until - self._clock()))
        if rest <= 0:
            return z3.unknown, None
        solver = z3.Solver()
        solver.set(timeout=rest // 5 if effort else rest, rlimit=effort)
        solver.add(*conditions)
        answer = solver.check()
        return answer, solver.model() if answer == z3.sat else None


def first_difference(
    questions: Questions, wrong: Mapping[str, Term], replay: Callable[[Any], None], *, in_induction: bool
) -> str | None:
    """Return why the two are not known to be equal, or None. Raises `DiffersError` for a difference that a run shows,
    and for a read beyond the message, whose effect a run may not show. Raises `MayDifferError` for any other
    difference in an induction.
    """
    unknown = None
    for text, condition in wrong.items():
        if z3.is_false(z3.simplify(condition)):
            continue
        answer, model = questions.decide(condition, replay)
        if model is not None:
            error = f"{text}, for {_example(model)}"
            if in_induction:
                raise MayDifferError(error)
            if text == READS_BEYOND:
                raise DiffersError(error)
            unknown = f"may differ, but no run shows it: {error}"
        elif answer != z3.unsat:
            unknown = unknown or "not decided in time"
    return unknown


def _holds(conditions: Sequence[Term], guess: Any) -> bool:
    values = [
        (declaration(), guess[declaration]) for declaration in guess.decls() if declaration.arity() == 0
    ]
    known = [
        (declaration, value)
        for declaration, value in values
        if value is not None and not isinstance(value, z3.FuncInterp)
    ]
    return all(z3.is_true(z3.simplify(z3.substitute(condition, *known))) for condition in conditions)


def _example(model: Any) -> str:
    return ", ".join(
        f"{declaration} = {model[declaration]}" for declaration in model.decls() if declaration.arity() == 0
    )
