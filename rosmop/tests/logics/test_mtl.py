from copy import copy
from random import Random
from typing import Any

import pytest
import reelay

from rosmop.logics.interface import ClockedProperty, FiniteProperty, Run
from rosmop.logics.past_monitors import PastProperty, PastRun, SinceWindow
from rosmop.tests.logics.driving import ABC, compiled, refusal, seeded
from rosmop.tests.logics.temporal import CONNECTIVES, Printer, Tree, draw

ARITY = {"not": 1, "previously": 1, "once": 1, "historically": 1}
TEMPORAL = ("previously", "once", "historically", "since")
PRINTER = Printer(
    {
        "previously": ("previously",),
        "once": ("once",),
        "historically": ("historically",),
        "since": ("since",),
    },
    [["since"], ["and"], ["xor"], ["or"], ["implies", "iff"]],
    ["implies", "iff"],
)
Timed = list[tuple[int, str]]


def bounded(tree: Tree, random: Random, largest: int) -> Tree:
    if tree[0] in ("event", "true", "false"):
        return tree
    operands = tuple(bounded(operand, random, largest) for operand in tree[1:])
    if tree[0] not in TEMPORAL or random.random() < 0.2:
        return (tree[0], *operands)
    low = random.choice([0, 0, random.randint(0, largest)])
    high = random.choice([None, low + random.randint(0, largest)])
    return (tree[0], *operands, (low, high))


def holds(tree: Tree, trace: Timed, i: int) -> bool:  # noqa: PLR0911  # one per operator
    operator, *rest = tree
    low, high = (0, None)
    if operator in TEMPORAL and rest and isinstance(rest[-1][0], int):
        low, high = rest.pop()

    def at(operand: int, position: int) -> bool:
        return holds(rest[operand], trace, position)

    def near(j: int) -> bool:
        distance = trace[i][0] - trace[j][0]
        return distance >= low and (high is None or distance <= high)

    past = range(i + 1)
    match operator:
        case "event":
            return bool(trace[i][1] == rest[0])
        case "true" | "false":
            return bool(operator == "true")
        case _ if operator in CONNECTIVES:
            return CONNECTIVES[operator](*(at(one, i) for one in range(len(rest))))
        case "previously":
            return i > 0 and near(i - 1) and at(0, i - 1)
        case "once":
            return any(near(j) and at(0, j) for j in past)
        case "historically":
            return all(at(0, j) for j in past if near(j))
        case "since":
            return any(near(j) and at(1, j) and all(at(0, k) for k in range(j + 1, i + 1)) for j in past)
    raise AssertionError(operator)


def verdicts(run: Run, trace: Timed, events: tuple[str, ...] = ABC) -> list[bool]:
    return [run.step(events.index(event), time) == ("validation",) for time, event in trace]


def timed_trace(random: Random, length: int, gap: int) -> Timed:
    time, trace = random.randint(0, 5), []
    for _ in range(length):
        time += random.choice([0, 1, random.randint(0, gap)])
        trace.append((time, random.choice(ABC)))
    return trace


def test_long_traces_by_definition() -> None:
    random = seeded(10)
    for low, high in ((0, 30), (10, None), (10, 40), (20, 20), (7, 9), (0, None), (0, 0)):
        for tree in (
            ("since", ("not", ("event", "c")), ("event", "a"), (low, high)),
            ("once", ("event", "a"), (low, high)),
        ):
            monitor = compiled("mtl", PRINTER.show(tree, random))
            trace = timed_trace(random, 250, 8)
            assert verdicts(monitor.start(0), trace) == [holds(tree, trace, i) for i in range(len(trace))]


def reelay_text(tree: Tree) -> str:  # noqa: PLR0911  # one per operator
    operator, *rest = tree
    bounds = ""
    if rest and isinstance(rest[-1][0], int):
        low, high = rest.pop()
        bounds = f"[{low}:{'inf' if high is None else high}]"
    parts = [reelay_text(operand) if isinstance(operand, tuple) else f"{{{operand}}}" for operand in rest]
    match operator:
        case "event":
            return parts[0]
        case "not":
            return f"(!{parts[0]})"
        case "and" | "or":
            return f"({parts[0]} {'&&' if operator == 'and' else '||'} {parts[1]})"
        case "implies":
            return f"({parts[0]} -> {parts[1]})"
        case "previously":
            return f"(pre {parts[0]})"
        case "once" | "historically":
            return f"({operator}{bounds} {parts[0]})"
        case "since":
            return f"({parts[0]} since{bounds} {parts[1]})"
    raise AssertionError(operator)


def expressible(tree: Tree) -> bool:
    """Whether the other monitor has the formula: it reads `[0:0]` as no bounds."""
    if isinstance(tree[-1], tuple) and tree[-1] == (0, 0):
        return False
    if tree[0] in ("true", "false", "xor", "iff") or (tree[0] == "previously" and len(tree) > 2):
        return False
    return tree[0] == "event" or all(expressible(part) for part in tree[1:] if isinstance(part[0], str))


def test_against_another_monitor() -> None:
    """With one event in each unit of time, verdicts agree with those of an independent discrete-time monitor."""
    random = seeded(11)
    compared = 0
    while compared < 80:
        tree = bounded(draw(random, 3, TEMPORAL, ARITY, ("a", "b")), random, 6)
        if not expressible(tree):
            continue
        compared += 1
        other: Any = reelay.discrete_timed_monitor(
            pattern=reelay_text(tree), semantics="boolean", condense=False
        )
        trace = [(time, random.choice(ABC)) for time in range(30)]
        theirs = [other.update({name: name == event for name in ("a", "b")})["value"] for _, event in trace]
        text = PRINTER.show(tree, random)
        assert verdicts(compiled("mtl", text).start(0), trace) == theirs, text


def test_a_formula_without_bounds_becomes_a_table() -> None:
    assert isinstance(compiled("mtl", "a since !b"), FiniteProperty)


@pytest.mark.parametrize(
    "text",
    [
        "a => once[0,3ns] b",
        "!c since[2ns,inf] a",
        "previously[0,2ns] (a or previously b)",
        "historically[0,0] (a => once b)",
    ],
)
def test_a_formula_with_one_bound_becomes_tables_and_a_clock(text: str) -> None:
    one, other = compiled("mtl", text), compiled("mtl", f"({text}) or once[1ns,1ns] false")
    assert isinstance(one, ClockedProperty)
    assert isinstance(other, PastProperty)
    random = seeded(14)
    for _ in range(200):
        trace = timed_trace(random, 12, 4)
        assert verdicts(one.start(0), trace) == verdicts(other.start(0), trace), trace


def test_a_copy_of_a_run_is_independent() -> None:
    random = seeded(12)
    for _ in range(300):
        tree = bounded(draw(random, 3, TEMPORAL, ARITY, ("a", "b")), random, 6)
        run = compiled("mtl", PRINTER.show(tree, random)).start(0)
        begun = timed_trace(random, 5, 4)
        verdicts(run, begun)
        runs = run, copy(run)
        traces = [
            [*begun, *((begun[-1][0] + time, event) for time, event in timed_trace(random, 5, 4))]
            for _ in runs
        ]
        for place in range(5, 10):
            for one, trace in zip(runs, traces, strict=True):
                assert verdicts(one, trace[place : place + 1]) == [holds(tree, trace, place)], (tree, trace)


def test_memory_of_values_that_are_not_needed_is_bounded() -> None:
    run = compiled("mtl", "a => once[1s,2s] b or previously[1s,2s] b").start(0)
    assert isinstance(run, PastRun)
    for second in range(0, 3_000, 3):
        assert run.step(1, second * 10**9) == ("validation",)
    assert all(len(value) <= 2 for value in run.values if isinstance(value, SinceWindow))


def test_memory_of_a_window_is_bounded_by_its_bounds() -> None:
    window = SinceWindow(1000, 1100)
    longest = 0
    for now in range(0, 200_000, 3):
        window.step(True, True, now)
        longest = max(longest, len(window))
    assert longest <= 12


def test_a_bound_of_thousands_of_digits_is_rejected() -> None:
    assert "digits" in refusal("mtl", f"once[0,{'9' * 5000}] a")[0]
