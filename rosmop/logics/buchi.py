"""Translate linear temporal logic to generalised Büchi automata (Gastin, Oddoux, CAV 2001).

A state of the automaton is an *obligation set*: nodes (``ltl_nodes``) that must all hold from here on.
Invariants:

- A transition fulfils an until in two cases: the until is not an obligation after it, or the step could also have
discharged the until with the same obligations left.
- An infinite run is accepting if its transitions fulfil each until infinitely often.
- ``live`` keeps exactly the states from which some infinite word is accepted. ``after`` and ``live`` drop a set that
includes another set, because only the union of languages counts there. The search for accepting runs keeps such sets.
"""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from typing import TypeVar

from rosmop.logics.formula import Formula
from rosmop.logics.ltl_nodes import FormulaNodes, FormulaTranslation

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

    def _fulfilled(self, letter: int, target: Obligations, untils: Obligations) -> Obligations:
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
                        missing &= ~self._fulfilled(letter, target, missing)
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
    found = []
    while bits:
        lowest = bits & -bits
        found.append(lowest.bit_length() - 1)
        bits ^= lowest
    return found


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
