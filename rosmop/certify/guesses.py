"""Replace the operators about the past in a formula about the future.

Their values are guessed with every event: a letter is an event and one bit for each operator. On every
endless trace, exactly one sequence of guesses satisfies their definitions. So a formula can come true with
guesses exactly if it could without them.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce

from rosmop.certify.formula_reader import Node, WorkLimitError

MOST_LETTERS = 1024

_DEFINED: Mapping[str, tuple[Callable[[Node, Node, Node], Node], bool]] = {
    "once": (lambda x, _y, before: ("or", x, before), False),
    "historically": (lambda x, _y, before: ("and", x, before), True),
    "since": (lambda x, y, before: ("or", y, ("and", x, before)), False),
    "dual since": (lambda x, y, before: ("and", y, ("or", x, before)), True),
}
"""For each operator: its value, from its operands and its previous value, and the value before the first event."""
_BEFORE: Mapping[str, bool] = {"previously": False, "dual previously": True}
"""For each operator: its value at the first event. Later it has the operand's value at the previous event."""


class PastGuesses:
    """The letters of each event, as numbers below `count`, and the formula over sets of them (`one of`)."""

    def __init__(self, formula: Node, events: Sequence[str]) -> None:
        self._guessed: dict[Node, int] = {}
        for node in _within(formula):
            if node[0] in _DEFINED or node[0] in _BEFORE:
                self._guessed.setdefault(node, len(self._guessed))
        count = 1 << len(self._guessed)
        if len(events) * count > MOST_LETTERS:
            raise WorkLimitError
        self.count = len(events) * count
        self.letters = {
            event: range(number * count, (number + 1) * count) for number, event in enumerate(events)
        }
        self.formula = self._over(formula)
        self.rules = [rule for node in self._guessed for rule in self._rules(node)]

    def kept(self, formula: Node) -> Node:
        return reduce(lambda left, right: ("and", left, right), self.rules, formula)

    def _over(self, node: Node) -> Node:
        if node in self._guessed:
            bit = 1 << self._guessed[node]
            return ("one of", sum(1 << letter for letter in range(self.count) if letter & bit))
        if node[0] == "event":
            return ("one of", sum(1 << letter for letter in self.letters[str(node[1])]))
        return (node[0], *(self._over(part) if isinstance(part, tuple) else part for part in node[1:]))

    def _rules(self, node: Node) -> list[Node]:
        mine = self._over(node)
        operator = str(node[0])
        operands = [self._over(part) for part in node[1:] if isinstance(part, tuple)]
        if operator in _BEFORE:
            first: Node = mine if _BEFORE[operator] else ("not", mine)
            return [first, ("always", _either(operands[0], ("next", mine), ("next", ("not", mine))))]
        define, at_first = _DEFINED[operator]
        worth = {
            before: ("iff", mine, define(operands[0], operands[-1], ("true",) if before else ("false",)))
            for before in (False, True)
        }
        return [worth[at_first], ("always", _either(mine, ("next", worth[True]), ("next", worth[False])))]


def _either(test: Node, yes: Node, no: Node) -> Node:
    return ("or", ("and", test, yes), ("and", ("not", test), no))


def _within(node: Node) -> list[Node]:
    return [node, *(inner for part in node[1:] if isinstance(part, tuple) for inner in _within(part))]
