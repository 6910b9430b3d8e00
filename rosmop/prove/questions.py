"""Ask z3 about one event: costly operations on numbers get their meaning only if the answer depends on it."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import z3

from rosmop.prove.concrete_runs import READS_BEYOND
from rosmop.prove.terms import Abstraction, DiffersError, Model, Term, either

_A_SECOND = 6_500_000
"""The effort of z3, in its own unit, that took a second of a processor for the events of the presets, on average."""
_TOGETHER = 20_000_000
"""The effort for all conditions at once: a few seconds, and a fifth of all at most."""
_MAX = 2**32 - 1
_SLOWEST = 20
"""The seconds after which z3 is ended, for each of `patience`: for work that it does not count."""


class MayDifferError(Exception):
    """The induction over the iterations of a loop fails for a state that may not occur."""


# z3 does not count what it spends before its search: there, a formula with floats took 10 GB.
z3.set_param("memory_high_watermark_mb", 2000)


class Effort:
    """The effort that is left for an event, so that the load of the machine decides nothing.

    `patience` is in seconds of a processor on the machine where `_A_SECOND` was measured.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._left = int(patience * _A_SECOND)

    def check(self, conditions: Sequence[Term], *, most: int = 0) -> tuple[z3.CheckSatResult, Model | None]:
        """Return whether the conditions are satisfiable, and a model, with the effort that is left, or with `most`."""
        if self._left <= 0:
            return z3.unknown, None
        solver, before = z3.Solver(), _counted(z3.Solver())
        effort = min(most, self._left // 5) if most else self._left
        solver.set(rlimit=min(max(1, effort), _MAX), timeout=int(1000 * _SLOWEST * self._patience))
        solver.add(*conditions)
        answer = solver.check()
        self._left -= _counted(z3.Solver()) - before
        return answer, solver.model() if answer == z3.sat else None


def _counted(solver: z3.Solver) -> int:
    """Return the effort of this process until now."""
    solver.check()
    return int(solver.statistics().get_key_value("rlimit count"))


class Questions:
    """Asks z3 about one event. The conditions `known` hold."""

    def __init__(self, effort: Effort, known: Sequence[Term]) -> None:
        self._effort, self._known = effort, known
        self._abstractions = Abstraction(floats=True), Abstraction()

    def exclude(self, conditions: Iterable[Term]) -> bool:
        """Whether none of the conditions can hold, whatever operations on floats calculate."""
        question = [*self._known, either(*map(z3.simplify, conditions))]
        answer, _ = self._effort.check(self._abstractions[0].of(question), most=_TOGETHER)
        return bool(answer == z3.unsat)

    def decide(
        self, condition: Term, replay: Callable[[Model], None] = lambda _: None
    ) -> tuple[z3.CheckSatResult, Model | None]:
        """Return whether the condition is satisfiable, and a model. Formulas without costly operations are tried
        first. `replay` gets each model, also of such a formula.
        """
        question, guess = [*self._known, condition], None
        for abstraction in self._abstractions:
            answer, guess = self._effort.check(abstraction.of(question))
            if answer == z3.unsat:
                return answer, None
        if guess is not None:
            replay(guess)
            if _holds(question, guess):
                return z3.sat, guess
        answer, model = self._effort.check(question)
        if model is not None:
            replay(model)
        return answer, model


def first_difference(
    questions: Questions, wrong: Mapping[str, Term], replay: Callable[[Model], None], *, in_induction: bool
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


def _holds(conditions: Sequence[Term], guess: Model) -> bool:
    values = [
        (declaration(), guess[declaration]) for declaration in guess.decls() if declaration.arity() == 0
    ]
    known = [
        (declaration, value)
        for declaration, value in values
        if value is not None and not isinstance(value, z3.FuncInterp)
    ]
    return all(z3.is_true(z3.simplify(z3.substitute(condition, *known))) for condition in conditions)


def _example(model: Model) -> str:
    return ", ".join(
        f"{declaration} = {model[declaration]}" for declaration in model.decls() if declaration.arity() == 0
    )
