"""Formulas of linear temporal logic in negation normal form, each stored once and identified by a number.

Exactly one letter holds at each position, so a boolean combination of atoms is one node ``letters``: the bit
set of its letters. The other nodes are ``and`` and ``or`` (flat), ``next``, ``until`` and ``release``.
"""

from collections.abc import Iterable, Mapping

from rosmop.logics.formula import Formula


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
