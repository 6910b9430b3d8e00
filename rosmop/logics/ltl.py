"""``ltl``: linear temporal logic over infinite traces, as MOP's LTL plugin reads it, with the verdicts of LTL3.

The formula and its negation each become a generalised Büchi automaton (``buchi``), without states that accept
no word. Both are determinised side by side: an empty left side is a violation, an empty right side a
validation (Bauer, Leucker, Schallhart).

An operator about the past is replaced by a proposition, whose value is guessed at each position. A formula
about the future is added that only the correct guesses satisfy (``_Past``). Every trace has exactly one
correct guess, so the formula and its negation keep exactly their traces. An event is the set of all letters
that differ only in the guesses.
"""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from typing import TypeVar

from rosmop.logics.automaton import TooManyStatesError, explore, letter_classes, spread
from rosmop.logics.formula import Formula, Level, Syntax, boolean_levels, event_names, nodes, read_formula
from rosmop.logics.interface import FiniteProperty, Source
from rosmop.logics.ptltl import SYNTAX as PTLTL

# Translate linear temporal logic to generalised Büchi automata (Gastin, Oddoux, CAV 2001).
#
# A state of the automaton is an *obligation set*: nodes (below) that must all hold from here on.
# Invariants:
#
# - A transition fulfils an until in two cases: the until is not an obligation after it, or the step could also have
# discharged the until with the same obligations left.
# - An infinite run is accepting if its transitions fulfil each until infinitely often.
# - ``live`` keeps exactly the states from which some infinite word is accepted. ``after`` and ``live`` drop a set that
# includes another set, because only the union of languages counts there. The search for accepting runs keeps such sets.

# Formulas of linear temporal logic in negation normal form, each stored once and identified by a number.
#
# Exactly one letter holds at each position, so a boolean combination of atoms is one node ``letters``: the bit
# set of its letters. The other nodes are ``and`` and ``or`` (flat), ``next``, ``until`` and ``release``.


class FormulaNodes:
    """The nodes over letters ``0 … letters-1``."""

    def __init__(self, letters: int) -> None:
        self.everything = (1 << letters) - 1
        self._numbers: dict[tuple[str, tuple[int, ...]], int] = {}
        self._nodes: list[tuple[str, tuple[int, ...]]] = []

    def __getitem__(self, node: int) -> tuple[str, tuple[int, ...]]:
        return self._nodes[node]

    def _intern(self, kind: str, parts: tuple[int, ...]) -> int:
        number = self._numbers.setdefault((kind, parts), len(self._nodes))
        if number == len(self._nodes):
            self._nodes.append((kind, parts))
        return number

    def letters(self, mask: int) -> int:
        return self._intern("letters", (mask,))

    def _mask(self, node: int) -> int | None:
        kind, parts = self._nodes[node]
        return parts[0] if kind == "letters" else None

    def join(self, kind: str, operands: Iterable[int]) -> int:
        mask = self.everything if kind == "and" else 0
        absorbing = 0 if kind == "and" else self.everything
        parts: set[int] = set()
        waiting = list(operands)
        while waiting:
            operand = waiting.pop()
            operand_kind, operand_parts = self._nodes[operand]
            if operand_kind == kind:
                waiting += operand_parts
            elif operand_kind == "letters":
                mask = mask & operand_parts[0] if kind == "and" else mask | operand_parts[0]
            else:
                parts.add(operand)
        if mask == absorbing or not parts:
            return self.letters(mask)
        if mask != self.everything - absorbing:
            parts.add(self.letters(mask))
        return parts.pop() if len(parts) == 1 else self._intern(kind, tuple(sorted(parts)))

    def next(self, operand: int) -> int:
        return operand if self._mask(operand) in (0, self.everything) else self._intern("next", (operand,))

    def until(self, left: int, right: int) -> int:
        """``right`` holds at some position, and ``left`` at all positions before it."""
        if self._mask(right) in (0, self.everything) or self._mask(left) == 0 or left == right:
            return right
        return self._intern("until", (left, right))

    def release(self, left: int, right: int) -> int:
        """``right`` holds up to and including the first position of ``left``, or always."""
        if self._mask(right) in (0, self.everything) or self._mask(left) == self.everything or left == right:
            return right
        return self._intern("release", (left, right))


class FormulaTranslation:
    """Translates formulas to shared nodes, with negations pushed down to the letters."""

    def __init__(self, nodes: FormulaNodes, atoms: Mapping[str, int]) -> None:
        self._nodes = nodes
        self._known: dict[tuple[int, bool], int] = {}
        self._atoms = atoms

    def node(self, formula: Formula, positive: bool) -> int:
        key = (id(formula), positive)
        if key not in self._known:
            self._known[key] = self._find(formula, positive)
        return self._known[key]

    def _find(self, formula: Formula, positive: bool) -> int:
        operator, operands = formula.operator, formula.operands
        if operator in ("event", "true", "false"):
            return self._atom(formula, positive)
        if operator == "not":
            return self.node(operands[0], not positive)
        if operator in ("xor", "iff"):
            return self._parity(operands, positive if operator == "xor" else not positive)
        if operator == "implies":
            sides = (self.node(operands[0], not positive), self.node(operands[1], positive))
            return self._nodes.join("or" if positive else "and", sides)
        parts = [self.node(operand, positive) for operand in operands]
        if operator in ("and", "or"):
            return self._nodes.join("and" if (operator == "and") == positive else "or", parts)
        return self._temporal(operator, parts, positive)

    def _atom(self, formula: Formula, positive: bool) -> int:
        everything = self._nodes.everything
        constants = {"true": everything, "false": 0}
        mask = constants.get(formula.operator, self._atoms.get(formula.name, 0))
        return self._nodes.letters(mask if positive else everything & ~mask)

    def _temporal(self, operator: str, parts: list[int], positive: bool) -> int:
        nodes = self._nodes
        if operator == "next":
            return nodes.next(parts[0])
        if operator in ("eventually", "always"):
            strong = (operator == "eventually") == positive
            parts = [nodes.letters(nodes.everything if strong else 0), *parts]
        else:
            strong = (operator == "until") == positive
        return nodes.until(parts[0], parts[1]) if strong else nodes.release(parts[0], parts[1])

    def _parity(self, operands: tuple[Formula, ...], odd: bool) -> int:
        nodes = self._nodes
        yes, no = self.node(operands[0], True), self.node(operands[0], False)
        for operand in operands[1:]:
            left, right = self.node(operand, True), self.node(operand, False)
            yes, no = (
                nodes.join("or", (nodes.join("and", (yes, right)), nodes.join("and", (no, left)))),
                nodes.join("or", (nodes.join("and", (yes, left)), nodes.join("and", (no, right)))),
            )
        return yes if odd else no


Obligations = int

Sets = frozenset[Obligations]

_Node = TypeVar("_Node", bound=Hashable)

MAX_OBLIGATION_SETS = 20_000
MAX_WORK = 1_500_000


class TooLargeError(Exception):
    """The automaton exceeds its limits."""


class Automata:
    """The nodes, their transitions and automata, over letters ``0 … letters-1``."""

    def __init__(self, letters: int) -> None:
        self._nodes = FormulaNodes(letters)
        self._chosen: dict[int, Sets] = {}
        self._moves: dict[tuple[int, int], Sets] = {}
        self._steps: dict[tuple[Obligations, int], Sets] = {}
        self._live: dict[Obligations, bool] = {}
        self._after: dict[tuple[Obligations, int], Sets] = {}
        self._work = 0

    def translate(self, formula: Formula, atoms: Mapping[str, int]) -> Sets:
        return self._choices(FormulaTranslation(self._nodes, atoms).node(formula, True))

    def _choices(self, node: int) -> Sets:
        known = self._chosen.get(node)
        if known is None:
            known = self._chosen[node] = self._find_choices(node)
        return known

    def _find_choices(self, node: int) -> Sets:
        kind, parts = self._nodes[node]
        if kind == "or":
            return self._smallest(choice for part in parts for choice in self._choices(part))
        if kind == "and":
            return self._product(self._choices(part) for part in parts)
        if kind == "letters" and parts[0] in (0, self._nodes.everything):
            return _NOTHING_LEFT if parts[0] else frozenset()
        return frozenset((1 << node,))

    def _product(self, factors: Iterable[Sets]) -> Sets:
        product = _NOTHING_LEFT
        for factor in factors:
            self._spend(len(product) * len(factor))
            product = self._smallest(left | right for left in product for right in factor)
        return product

    def _smallest(self, sets: Iterable[Obligations]) -> Sets:
        kept: list[Obligations] = []
        for candidate in sorted(set(sets), key=int.bit_count):
            self._spend(1 + len(kept) // 8)
            if not any(smaller & candidate == smaller for smaller in kept):
                kept.append(candidate)
        return frozenset(kept)

    def _spend(self, amount: int) -> None:
        self._work += amount
        if self._work > MAX_WORK:
            raise TooLargeError

    def _move(self, node: int, letter: int) -> Sets:
        known = self._moves.get((node, letter))
        if known is None:
            known = self._moves[node, letter] = self._find_move(node, letter)
        return known

    def _find_move(self, node: int, letter: int) -> Sets:
        kind, parts = self._nodes[node]
        if kind == "letters":
            return _NOTHING_LEFT if parts[0] >> letter & 1 else frozenset()
        if kind == "next":
            return self._choices(parts[0])
        if kind == "or":
            return self._smallest(move for part in parts for move in self._move(part, letter))
        if kind == "and":
            return self._product(self._move(part, letter) for part in parts)
        left, right = self._move(parts[0], letter), self._move(parts[1], letter)
        stay: Sets = frozenset((1 << node,))
        if kind == "until":
            return self._smallest((*right, *self._product((left, stay))))
        return self._product((right, frozenset((*left, *stay))))

    def _transitions(self, state: Obligations, letter: int) -> Sets:
        """Return the transitions. Sets that include another set are kept, because acceptance needs them."""
        known = self._steps.get((state, letter))
        if known is None:
            targets: set[Obligations] = {0}
            for node in _members(state):
                moves = self._move(node, letter)
                self._spend(len(targets) * len(moves) + 1)
                targets = {left | right for left in targets for right in moves}
            known = self._steps[state, letter] = frozenset(targets)
        return known

    def _fulfil(self, letter: int, target: Obligations, untils: Obligations) -> Obligations:
        self._spend(1)
        found = untils & ~target
        for until in _members(untils & target):
            if any(not move >> until & 1 and move & target == move for move in self._move(until, letter)):
                found |= 1 << until
        return found

    def live(self, states: Sets) -> Sets:
        fresh = [state for state in states if state not in self._live]
        if fresh:
            self._decide_live(fresh)
        return self._smallest(state for state in states if self._live[state])

    def _decide_live(self, fresh: list[Obligations]) -> None:
        edges: dict[Obligations, list[tuple[int, Obligations]]] = {}
        waiting = list(fresh)
        while waiting:
            state = waiting.pop()
            if state in edges:
                continue
            edges[state] = [
                (letter, target)
                for letter in _members(self._possible(state))
                for target in self._transitions(state, letter)
            ]
            if len(edges) > MAX_OBLIGATION_SETS:
                raise TooLargeError
            self._spend(len(edges[state]))
            waiting += [target for _, target in edges[state] if target not in edges]
        untils = 0
        for state in edges:
            untils |= state
        untils = sum(1 << node for node in _members(untils) if self._nodes[node][0] == "until")
        for component in strong_components(edges, lambda state: [target for _, target in edges[state]]):
            inner = set(component)
            missing = untils
            cyclic = alive = False
            for state in component:
                for letter, target in edges[state]:
                    if target in inner:
                        cyclic = True
                        missing &= ~self._fulfil(letter, target, missing)
                    elif self._live[target]:
                        alive = True
            verdict = alive or (cyclic and not missing)
            for state in component:
                self._live[state] = verdict

    def after(self, states: Sets, letters: int) -> Sets:
        return self._smallest(
            target
            for state in states
            for letter in _members(self._possible(state) & letters)
            for target in self._live_after(state, letter)
        )

    def _possible(self, state: Obligations) -> int:
        letters = self._nodes.everything
        for node in _members(state):
            kind, parts = self._nodes[node]
            if kind == "letters":
                letters &= parts[0]
        return letters

    def _live_after(self, state: Obligations, letter: int) -> Sets:
        known = self._after.get((state, letter))
        if known is None:
            known = self._after[state, letter] = self.live(self._transitions(state, letter))
        return known


_NOTHING_LEFT: Sets = frozenset((0,))


def _members(bits: int) -> list[int]:
    members = []
    while bits:
        lowest = bits & -bits
        members.append(lowest.bit_length() - 1)
        bits ^= lowest
    return members


def strong_components(
    nodes: Iterable[_Node], successors: Callable[[_Node], Iterable[_Node]]
) -> list[list[_Node]]:
    index: dict[_Node, int] = {}
    low: dict[_Node, int] = {}
    open_nodes: dict[_Node, None] = {}
    components: list[list[_Node]] = []
    for root in nodes:
        if root in index:
            continue
        path: list[tuple[_Node, Iterator[_Node]]] = []
        current: _Node | None = root
        while current is not None or path:
            if current is not None:
                index[current] = low[current] = len(index)
                open_nodes[current] = None
                path.append((current, iter(successors(current))))
            node, rest = path[-1]
            current = None
            for target in rest:
                if target not in index:
                    current = target
                    break
                if target in open_nodes:
                    low[node] = min(low[node], index[target])
            if current is not None:
                continue
            path.pop()
            if path:
                parent = path[-1][0]
                low[parent] = min(low[parent], low[node])
            if low[node] == index[node]:
                component = []
                while True:
                    member, _ = open_nodes.popitem()
                    component.append(member)
                    if member == node:
                        break
                components.append(component)
    return components


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
MAX_LETTERS = 1024
"""Bounds the number of past operators: each of them doubles the classes of events."""


def compile_ltl(source: Source) -> FiniteProperty:
    formula = read_formula(source, SYNTAX)
    _refuse_past_alone(source, formula)
    named = event_names(formula)
    of_event, classes = letter_classes(source.events, named)
    past = _Past()
    future = past.replace(formula)
    guesses = 1 << len(past.propositions)
    if len(classes) * guesses > MAX_LETTERS:
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
            _settle(starts[0], starts[1]),
            len(classes),
            lambda state, letter: _settle(*(automata.after(side, of_class[letter]) for side in state)),
            lambda state: ("violation",) if not state[0] else ("validation",) if not state[1] else (),
        )
    except TooManyStatesError as error:
        raise source.error(0, f"the monitor of this formula has {error}; write a smaller one") from None
    except TooLargeError:
        raise source.error(
            0, "the monitor of this formula is too large to build; write a smaller one"
        ) from None
    return FiniteProperty(source, VERDICTS, spread(automaton, of_event))


def _settle(for_it: Sets, against_it: Sets) -> tuple[Sets, Sets]:
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

    def replace(self, formula: Formula) -> Formula:
        operator = formula.operator
        operands = tuple(self.replace(operand) for operand in formula.operands)
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
