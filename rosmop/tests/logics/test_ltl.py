"""``ltl``: verdicts are compared with the meaning of the formula on ultimately periodic traces."""

from itertools import product

import pytest

from rosmop.tests.logics.driving import compiled, refusal, seeded, told
from rosmop.tests.logics.temporal import CONNECTIVES, Printer, Tree, draw

AB = ("a", "b")
UNARY = {"not": 1, "next": 1, "always": 1, "eventually": 1}
TEMPORAL = ("next", "always", "eventually", "until", "release")
PAST = ("previously", "once", "historically", "since", "dual since", "dual previously")
PRINTER = Printer(
    {
        "next": ("o", "~o"), "always": ("[]",), "eventually": ("<>",), "until": ("U",), "release": ("R", "~U"),
        "previously": ("(*)",), "once": ("<*>",), "historically": ("[*]",), "since": ("S",), "dual since": ("~S",),
        "dual previously": ("~(*)",),
    },
    [["and"], ["xor"], ["or"], ["until", "release", "since", "dual since", "implies", "iff"]],
    ["until", "release", "since", "dual since", "implies", "iff"],
)  # fmt: skip

Lasso = tuple[tuple[str, ...], int]
"""An endless trace: its positions, and the position to which the last one leads back."""


def lassos(events: tuple[str, ...], stem: int, loop: int) -> list[Lasso]:
    return [
        (word, length)
        for length in range(stem + 1)
        for turn in range(1, loop + 1)
        for word in product(events, repeat=length + turn)
    ]


def holds(tree: Tree, lasso: Lasso) -> list[bool]:  # noqa: PLR0911  # one per kind of operator
    word, back = lasso
    size = len(word)
    after = [*range(1, size), back]
    operator = tree[0]
    if operator == "event":
        return [event == tree[1] for event in word]
    if operator in ("true", "false"):
        return [operator == "true"] * size
    values = [holds(operand, lasso) for operand in tree[1:]]
    if operator == "next":
        return [values[0][after[i]] for i in range(size)]
    if operator in ("always", "eventually"):
        tail = [{*range(i, size), *range(back, size)} for i in range(size)]
        test = all if operator == "always" else any
        return [test(values[0][j] for j in tail[i]) for i in range(size)]
    if operator in PAST:
        truth = looking_back(operator, values)
        turn = size - back
        assert truth[-turn:] == truth[-2 * turn : -turn], "the trace is not unrolled far enough"
        return truth
    if operator in ("until", "release"):
        truth = [operator == "release"] * size
        for _ in range(size + 1):
            for i in reversed(range(size)):
                if operator == "until":
                    truth[i] = values[1][i] or (values[0][i] and truth[after[i]])
                else:
                    truth[i] = values[1][i] and (values[0][i] or truth[after[i]])
        return truth
    return [CONNECTIVES[operator](*(value[i] for value in values)) for i in range(size)]


def looking_back(operator: str, values: list[list[bool]]) -> list[bool]:
    truth: list[bool] = []
    for i, value in enumerate(values[-1]):
        if operator in ("previously", "dual previously"):
            truth.append(values[0][i - 1] if i else operator == "dual previously")
        elif operator in ("once", "since"):
            reach = values[0] if operator == "since" else [True] * (i + 1)
            truth.append(any(values[-1][j] and all(reach[j + 1 : i + 1]) for j in range(i + 1)))
        elif operator == "historically":
            truth.append(all(values[0][: i + 1]))
        else:
            truth.append(value and (all(values[1][: i + 1]) or any(
                values[0][j] and all(values[1][j : i + 1]) for j in range(i + 1)
            )))  # fmt: skip
    return truth


def by_enumeration(tree: Tree, words: list[Lasso], longest: int) -> dict[tuple[str, ...], tuple[str, ...]]:
    verdicts: dict[tuple[str, ...], set[bool]] = {}
    for lasso in words:
        truth = holds(tree, lasso)[0]
        unrolled = list(lasso[0])
        while len(unrolled) < longest:
            unrolled += lasso[0][lasso[1] :]
        for length in range(1, longest + 1):
            verdicts.setdefault(tuple(unrolled[:length]), set()).add(truth)
    names = {
        frozenset({True}): ("validation",),
        frozenset({False}): ("violation",),
        frozenset({True, False}): (),
    }
    return {prefix: names[frozenset(found)] for prefix, found in verdicts.items()}


def unrolled(lasso: Lasso, turns: int) -> Lasso:
    word, back = lasso
    loop = word[back:]
    return word + loop * turns, len(word) + len(loop) * (turns - 1)


def has(tree: Tree, operators: tuple[str, ...]) -> bool:
    return tree[0] in operators or any(has(part, operators) for part in tree[1:] if isinstance(part, tuple))


def test_many_operators_about_the_past() -> None:
    monitor = compiled("ltl", "[](a => " + "(*) " * 7 + "b)", AB)
    assert told(monitor, "bbbbbbbab")[-2:] == [(), ()]
    assert told(monitor, "abbbbbbaa") == [("violation",)] * 9
    assert told(monitor, "b" + "b" * 7 + "a" * 8 + "a")[-2:] == [("violation",)] * 2


def test_long_traces_of_random_formulas() -> None:
    random = seeded(6)
    for _ in range(400):
        tree = draw(random, 4, TEMPORAL, UNARY, ("a", "b", "c"))
        monitor = compiled("ltl", PRINTER.show(tree, random), ("a", "b", "c", "x"))
        stem = tuple(random.choices("abcx", k=6))
        loop = tuple(random.choices("abcx", k=3))
        told_so_far = told(monitor, stem + loop * 20)
        final = told_so_far[-1]
        if final:
            assert (final == ("validation",)) == holds(tree, (stem + loop, 6))[0]
        decided = [verdict for verdict in told_so_far if verdict]
        assert decided == [final] * len(decided)


def test_a_formula_with_too_many_operators_about_the_past_is_rejected() -> None:
    assert "10 different past operators" in refusal("ltl", "[](a => " + "(*) " * 10 + "b)")[0]


@pytest.mark.parametrize(
    "text",
    [
        "<>(a and " + "o " * 40 + "b)",
        "!" * 100_000 + "a",
        "(" * 90_000,
        " and ".join(f"<>(a and {'o ' * i} b)" for i in range(1, 30)),
        "a or " * 100_000 + "a",
    ],
)
def test_hostile_formulas_are_refused(text: str) -> None:
    assert len(refusal("ltl", text)) == 1


def test_nested_parity_is_small() -> None:
    text = "[] a"
    for number in range(60):
        text = f"({text}) {'xor' if number % 2 else '<=>'} b"
    assert compiled("ltl", text).categories == ("violation", "validation")
