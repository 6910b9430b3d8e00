"""``ltl``: linear temporal logic over infinite traces, as MOP's LTL plugin reads it, with the verdicts of LTL3.

The formula and its negation each become a generalised Büchi automaton (``buchi``), without states that accept
no word. Both are determinised side by side: an empty left side is a violation, an empty right side a
validation (Bauer, Leucker, Schallhart).

An operator about the past is replaced by a proposition, whose value is guessed at each position. A formula
about the future is added that only the correct guesses satisfy (``_Past``). Every trace has exactly one
correct guess, so the formula and its negation keep exactly their traces. An event is the set of all letters
that differ only in the guesses.
"""

from rosmop.logics.automaton import TooManyStatesError, explore, letter_classes, spread
from rosmop.logics.buchi import Automata, Sets, TooLargeError
from rosmop.logics.formula import Formula, Level, Syntax, boolean_levels, event_names, nodes, read_formula
from rosmop.logics.interface import FiniteProperty, Source
from rosmop.logics.ptltl import SYNTAX as PTLTL

_LEVELS = boolean_levels([])
SYNTAX = Syntax(
    unary={**PTLTL.unary, "o": "next", "~o": "next", "[]": "always", "<>": "eventually"},
    levels=(
        *_LEVELS[:-1],
        Level(
            {
                **_LEVELS[-1].operators,
                "U": "until",
                "R": "release",
                "~U": "release",
                "S": "since",
                "~S": "dual since",
            },
            "once",
        ),
    ),
    refused={
        "~": "has no meaning in ltl; write `!` for a negation",
        "X": "is not an operator of ltl; write `o` for next",
        "F": "is not an operator of ltl; write `<>` for eventually",
        "G": "is not an operator of ltl; write `[]` for always",
        "W": "is not an operator of ltl; write `b R (a or b)` for `a W b`",
    },
)
_PAST = {"previously", "dual previously", "historically", "once", "since", "dual since"}
_FUTURE = {"next", "always", "eventually", "until", "release"}
VERDICTS = ("violation", "validation")
MOST_LETTERS = 1024
"""Bounds the number of past operators: each of them doubles the classes of events."""


def compile_ltl(source: Source) -> FiniteProperty:
    formula = read_formula(source, SYNTAX)
    _refuse_past_alone(source, formula)
    named = event_names(formula)
    of_event, classes = letter_classes(source.events, named)
    past = _Past()
    future = past.replaced(formula)
    guesses = 1 << len(past.propositions)
    if len(classes) * guesses > MOST_LETTERS:
        raise source.error(0, f"{len(past.propositions)} different past operators; write a smaller formula")
    of_class = [((1 << guesses) - 1) << letter * guesses for letter in range(len(classes))]
    atoms = {named[index]: of_class[letter] for letter, index in enumerate(classes) if index >= 0}
    letters = range(len(classes) * guesses)
    for number, name in enumerate(past.propositions.values()):
        atoms[name] = sum(1 << letter for letter in letters if letter >> number & 1)
    automata = Automata(len(letters))
    sides = [Formula("and", (side, *past.right)) for side in (future, _not(future))]
    try:
        starts = [automata.live(automata.translate(side, atoms)) for side in sides]
        automaton = explore(
            _settled(starts[0], starts[1]),
            len(classes),
            lambda state, letter: _settled(*(automata.after(side, of_class[letter]) for side in state)),
            lambda state: ("violation",) if not state[0] else ("validation",) if not state[1] else (),
        )
    except TooManyStatesError as error:
        raise source.error(0, f"the monitor of this formula has {error}; write a smaller one") from None
    except TooLargeError:
        raise source.error(
            0, "the monitor of this formula is too large to build; write a smaller one"
        ) from None
    return FiniteProperty(source, VERDICTS, spread(automaton, of_event))


def _settled(for_it: Sets, against_it: Sets) -> tuple[Sets, Sets]:
    if not for_it:
        return frozenset(), _SOMETHING
    if not against_it:
        return _SOMETHING, frozenset()
    return for_it, against_it


_SOMETHING: Sets = frozenset((0,))


class _Past:
    def __init__(self) -> None:
        self.propositions: dict[Formula, str] = {}
        self.right: list[Formula] = []

    def replaced(self, formula: Formula) -> Formula:
        operator = formula.operator
        operands = tuple(self.replaced(operand) for operand in formula.operands)
        if operator == "once":
            return self._proposition("since", (Formula("true"), *operands))
        if operator == "historically":
            return _not(self._proposition("since", (Formula("true"), _not(operands[0]))))
        if operator.startswith("dual "):
            return _not(self._proposition(operator.removeprefix("dual "), tuple(map(_not, operands))))
        if operator in _PAST:
            return self._proposition(operator, operands)
        return Formula(operator, operands, formula.name)

    def _proposition(self, operator: str, operands: tuple[Formula, ...]) -> Formula:
        formula = Formula(operator, operands)
        if formula in self.propositions:
            return Formula("event", name=self.propositions[formula])
        name = self.propositions[formula] = f"past {len(self.propositions)}"
        mine = Formula("event", name=name)
        if operator == "previously":
            first = _not(mine)
            ways = ((operands[0], mine), (_not(operands[0]), first))
        else:
            left, right = operands
            first = Formula("iff", (mine, right))
            ways = ((mine, Formula("iff", (mine, Formula("or", (right, left))))), (_not(mine), first))
        after = (Formula("implies", (now, Formula("next", (following,)))) for now, following in ways)
        self.right += [first, *(Formula("always", (formula,)) for formula in after)]
        return mine


def _not(formula: Formula) -> Formula:
    return Formula("not", (formula,))


def _refuse_past_alone(source: Source, formula: Formula) -> None:
    past = [node for node in nodes(formula) if node.operator in _PAST]
    if past and not any(node.operator in _FUTURE for node in nodes(formula)):
        raise source.error(past[0].offset, "a formula about the past; write `ptltl:` for `ltl:`")
