"""Formulas about the past, by their definition."""

from collections.abc import Callable, Mapping

from rosmop.certify.formula_reader import Node

State = tuple[bool, ...]


class PastFollower:
    """Follows a past formula. A state is the memory of each operator that looks back."""

    def __init__(self, formula: Node) -> None:
        self._parts: dict[Node, int] = {}
        self._looking: list[tuple[Node, int]] = []
        self._file(formula)
        self._order = list(self._parts)
        # The first event has no past. There, operators about all of the past are true, and operators about some of it
        # are false.
        self.initial: State = tuple(
            node[0] in ("historically", "dual since", "dual previously") for node, _ in self._looking
        )

    def _file(self, node: Node) -> int:
        for operand in node[1:]:
            if isinstance(operand, tuple):
                self._file(operand)
        if node not in self._parts:
            self._parts[node] = len(self._parts)
            if node[0] in _LOOKING:
                self._looking.append((node, len(self._looking)))
        return self._parts[node]

    def step(self, state: State, event: str) -> tuple[State, bool]:
        before = {node: state[place] for node, place in self._looking}
        now: dict[Node, bool] = {}
        for node in self._order:
            now[node] = _value(node, now, before, event)
        kept = tuple(
            now[_operand(node)] if node[0] in ("previously", "dual previously") else now[node]
            for node, _ in self._looking
        )
        return kept, now[self._order[-1]]


_LOOKING = frozenset(("previously", "dual previously", "once", "historically", "since", "dual since"))


def _operand(node: Node, number: int = 1) -> Node:
    operand = node[number]
    assert isinstance(operand, tuple)  # noqa: S101  operators have formulas as operands
    return operand


def _value(node: Node, now: dict[Node, bool], before: dict[Node, bool], event: str) -> bool:
    operator = str(node[0])
    if operator == "event":
        return node[1] == event
    if operator in ("true", "false"):
        return operator == "true"
    if operator in ("previously", "dual previously"):
        return before[node]
    values = [now[_operand(node, number)] for number in range(1, len(node))]
    return _MEANING[operator](values[0], values[-1], before.get(node, False))


_MEANING: Mapping[str, Callable[[bool, bool, bool], bool]] = {
    "not": lambda x, _y, _before: not x,
    "and": lambda x, y, _before: x and y,
    "or": lambda x, y, _before: x or y,
    "xor": lambda x, y, _before: x != y,
    "implies": lambda x, y, _before: not x or y,
    "iff": lambda x, y, _before: x == y,
    "once": lambda x, _y, before: x or before,
    "historically": lambda x, _y, before: x and before,
    "since": lambda x, y, before: y or (x and before),
    "dual since": lambda x, y, before: y and (x or before),  # not (not x since not y)
}
