from functools import cache
from random import Random
from typing import Any

import pytest
from greenery import Charclass
from greenery.fsm import Fsm

from rosmop.logics.interface import FiniteProperty
from rosmop.tests.logics.driving import ABC, compiled, refusal, seeded

Tree = tuple[Any, ...]


def draw(random: Random, depth: int) -> Tree:
    if depth == 0 or random.random() < 0.15:
        return (random.choice(["a", "b", "c", "a", "b", "c", "epsilon", "empty"]),)
    kind = random.choice(["|", "&", "cat", "cat", "~", "*", "+", "^"])
    if kind in ("|", "&", "cat"):
        return (kind, draw(random, depth - 1), draw(random, depth - 1))
    if kind == "^":
        return (kind, draw(random, depth - 1), random.randint(0, 3))
    return (kind, draw(random, depth - 1))


STRENGTH = {"|": 0, "&": 1, "cat": 2, "~": 3, "*": 4, "+": 4, "^": 4}


def show(tree: Tree, random: Random) -> str:
    kind = tree[0]
    if len(tree) == 1:
        return str(kind)
    strength = STRENGTH[kind]

    def inside(operand: Tree, least: int) -> str:
        needed = len(operand) > 1 and STRENGTH[operand[0]] < least
        text = show(operand, random)
        return f"({text})" if needed or random.random() < 0.1 else text

    if kind in ("|", "&", "cat"):
        sign = {"|": "|", "&": " & ", "cat": " "}[kind]
        return sign.join(inside(operand, strength) for operand in tree[1:])
    if kind == "~":
        return "~" + inside(tree[1], 3)
    return inside(tree[1], 4) + (f"^{tree[2]}" if kind == "^" else kind)


@cache
def member(tree: Tree, word: tuple[str, ...]) -> bool:  # noqa: PLR0911  # one per operator
    kind = tree[0]
    if kind in ABC:
        return word == (kind,)
    if kind in ("epsilon", "empty"):
        return kind == "epsilon" and not word
    if kind == "|":
        return member(tree[1], word) or member(tree[2], word)
    if kind == "&":
        return member(tree[1], word) and member(tree[2], word)
    if kind == "~":
        return not member(tree[1], word)
    if kind == "cat":
        return any(
            member(tree[1], word[:cut]) and member(tree[2], word[cut:]) for cut in range(len(word) + 1)
        )
    if kind == "^":
        return (
            member(("epsilon",), word)
            if tree[2] == 0
            else member(("cat", tree[1], ("^", tree[1], tree[2] - 1)), word)
        )
    if kind == "+":
        return member(("cat", tree[1], ("*", tree[1])), word)
    return not word or any(
        member(tree[1], word[:cut]) and member(tree, word[cut:]) for cut in range(1, len(word) + 1)
    )


LETTERS = {event: Charclass(event) for event in ABC}
REST = ~Charclass("abc")
ALPHABET = [*LETTERS.values(), REST]


def machine(finals: set[int], moves: dict[int, dict[str, int]]) -> Fsm:
    states = {*moves, *finals, 9}
    table = {
        state: dict.fromkeys(ALPHABET, 9)
        | {LETTERS[event]: target for event, target in moves.get(state, {}).items()}
        for state in states
    }
    return Fsm(alphabet=ALPHABET, states=states, initial=0, finals=finals, map=table)


def other_library(tree: Tree) -> Fsm:  # noqa: PLR0911  # one per operator
    kind = tree[0]
    if kind in ABC:
        return machine({1}, {0: {kind: 1}, 1: {}})
    if kind in ("epsilon", "empty"):
        return machine({0} if kind == "epsilon" else set(), {0: {}})
    first = other_library(tree[1])
    if kind == "|":
        return first | other_library(tree[2])
    if kind == "&":
        return first & other_library(tree[2])
    if kind == "cat":
        return first + other_library(tree[2])
    if kind == "~":
        return first.everythingbut() & machine({0}, {0: dict.fromkeys(ABC, 0)})
    if kind == "^":
        return first * tree[2]
    return first.star() if kind == "*" else first + first.star()


def test_match_and_fail_against_another_library() -> None:
    random = seeded(4)
    for _ in range(500):
        tree = draw(random, 3)
        monitor = compiled("ere", show(tree, random))
        assert isinstance(monitor, FiniteProperty)
        mine, other = monitor.automaton, other_library(tree).reduce()
        seen = set()
        waiting = [(mine.initial, other.initial)]
        while waiting:
            pair = waiting.pop()
            for index, event in enumerate(ABC):
                target = (mine.table[pair[0]][index], other.map[pair[1]][LETTERS[event]])
                expected = (
                    ("match",) if target[1] in other.finals else () if other.islive(target[1]) else ("fail",)
                )
                assert mine.verdicts[target[0]] == expected, (tree, event)
                if target not in seen:
                    seen.add(target)
                    waiting.append(target)


@pytest.mark.parametrize(
    "text",
    ["(a|b)* a (a|b)^40", "a^999999", "((a^70)^70)^70", "(" * 5000 + "a", "~" * 5000 + "a", "a " * 400_000],
)
def test_hostile_expressions_are_refused(text: str) -> None:
    assert len(refusal("ere", text)) == 1
