"""``ltl``: future linear temporal logic over infinite traces, as MOP's LTL plugin reads it, with three
verdicts.

Each event is one position, where exactly its own atom holds. The category is ``violation`` once no
continuation satisfies the formula, ``validation`` once all do; both are for good. (Bauer, Leucker,
Schallhart: LTL3.)

Theory of operation: the formula and its negation are brought into normal form and each becomes a
generalised Büchi automaton (``buchi``). States without an accepted word are cut away; both automata are
determinised side by side; an empty left side is a violation, an empty right side a validation. The result
is minimised.
"""

from appliance.rosmop.logics.automaton import TooManyStatesError, explore, letter_classes, spread
from appliance.rosmop.logics.buchi import Automata, Sets, TooLargeError
from appliance.rosmop.logics.formula import (
    NOT,
    Formula,
    Level,
    Syntax,
    boolean_levels,
    event_names,
    nodes,
    read_formula,
)
from appliance.rosmop.logics.interface import FiniteProperty, FormulaError, Source

_LEVELS = boolean_levels([])
SYNTAX = Syntax(
    unary={
        **NOT,
        "o": "next",
        "~o": "next",
        "[]": "always",
        "<>": "eventually",
        "(*)": "previously",
        "~(*)": "previously",
        "[*]": "historically",
        "<*>": "once",
    },
    levels=(
        *_LEVELS[:-1],
        Level(
            {
                **_LEVELS[-1].operators,
                "U": "until",
                "R": "release",
                "~U": "release",
                "S": "since",
                "~S": "since",
            },
            "once",
        ),
    ),
    refused={
        "~": "has no meaning in ltl; write `!` for a negation",
        "X": "is no operator of ltl; write `o` for next",
        "F": "is no operator of ltl; write `<>` for eventually",
        "G": "is no operator of ltl; write `[]` for always",
        "W": "is no operator of ltl; write `b R (a or b)` for `a W b`",
    },
)
_PAST = {"previously", "historically", "once", "since"}
_FUTURE = {"next", "always", "eventually", "until", "release"}
VERDICTS = ("violation", "validation")


def compile_ltl(source: Source) -> FiniteProperty:
    """Compile an ``ltl`` formula. Raises FormulaError."""
    formula = read_formula(source, SYNTAX)
    _refuse_past(source, formula)
    named = event_names(formula)
    of_event, classes = letter_classes(source.events, named)
    atoms = {named[index]: 1 << letter for letter, index in enumerate(classes) if index >= 0}
    automata = Automata(len(classes))
    try:
        starts = [automata.live(automata.translate(formula, atoms, positive=sign)) for sign in (True, False)]
        automaton = explore(
            _settled(starts[0], starts[1]),
            len(classes),
            lambda state, letter: _settled(
                automata.after(state[0], letter), automata.after(state[1], letter)
            ),
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
    """A pair of states; once the verdict is certain, what is left of the other side does not matter."""
    if not for_it:
        return frozenset(), _SOMETHING
    if not against_it:
        return _SOMETHING, frozenset()
    return for_it, against_it


_SOMETHING: Sets = frozenset((0,))


def _refuse_past(source: Source, formula: Formula) -> None:
    past = [node for node in nodes(formula) if node.operator in _PAST]
    if not past:
        return
    if any(node.operator in _FUTURE for node in nodes(formula)):
        text = "past and future operators in one formula are not supported yet; write a property for each"
    else:
        text = "a formula about the past; write `ptltl:` for `ltl:`"
    raise FormulaError([source.finding(past[0].offset, text)])
