"""Random temporal formulas as trees, and their text with as few parentheses as the precedence allows."""

from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any

Tree = tuple[Any, ...]
"""(operator, operand, …); an event is ("event", name); bounds are the last operand of a timed operator."""

CONNECTIVES: Mapping[str, Callable[..., bool]] = {
    "not": lambda one: not one,
    "and": lambda left, right: left and right,
    "or": lambda left, right: left or right,
    "xor": lambda left, right: left != right,
    "implies": lambda left, right: not left or right,
    "iff": lambda left, right: left == right,
}
BOOLEAN = tuple(connective for connective in CONNECTIVES if connective != "not")
SPELLED = {
    "not": ("!", "not "),
    "and": ("and",),
    "or": ("or",),
    "xor": ("xor",),
    "implies": ("=>", "->"),
    "iff": ("<=>", "<->"),
}


def draw(
    random: Random, depth: int, operators: Sequence[str], arity: Mapping[str, int], events: Sequence[str]
) -> Tree:
    if depth == 0 or random.random() < 0.12:
        return random.choice(
            [
                *(("event", event) for event in events),
                *(("event", event) for event in events),
                ("true",),
                ("false",),
            ]
        )
    operator = random.choice([*operators, *operators, *CONNECTIVES])
    return (
        operator,
        *(draw(random, depth - 1, operators, arity, events) for _ in range(arity.get(operator, 2))),
    )


ARITY = {"not": 1}


class Printer:
    def __init__(
        self, spelled: Mapping[str, Sequence[str]], levels: Sequence[Sequence[str]], once: Sequence[str]
    ) -> None:
        self.spelled = {**SPELLED, **spelled}
        self._strength = {operator: number for number, level in enumerate(levels, 1) for operator in level}
        self._once = set(once)

    def show(self, tree: Tree, random: Random) -> str:
        operator = tree[0]
        if operator == "event":
            return str(tree[1])
        if operator in ("true", "false"):
            return str(operator)
        operands = [operand for operand in tree[1:] if operand and isinstance(operand[0], str)]
        bounds = next(
            (
                f"[{operand[0]}ns,{'inf' if operand[1] is None else f'{operand[1]}ns'}]"
                for operand in tree[1:]
                if operand not in operands
            ),
            "",
        )
        sign = random.choice(self.spelled[operator]) + bounds
        strength = self._strength.get(operator, 0)
        if len(operands) == 1:
            return f"{sign} {self._inside(operands[0], 0, random)}"
        left = strength - 1 if operator in self._once else strength
        return f"{self._inside(operands[0], left, random)} {sign} {self._inside(operands[1], strength - 1, random)}"

    def _inside(self, tree: Tree, loosest: int, random: Random) -> str:
        text = self.show(tree, random)
        needed = self._strength.get(tree[0], 0) > loosest
        return f"({text})" if needed or random.random() < 0.1 else text
