"""``mtl`` about the future: compared with its three-valued definition, and with the complete trace."""

import importlib
import sys
from collections.abc import Callable
from random import Random
from types import FrameType
from typing import Any

import pytest

from rosmop.logics import bounded
from rosmop.logics.interface import RunFaultError
from rosmop.tests.logics.driving import ABC, compiled, play, seeded
from rosmop.tests.logics.temporal import Printer, Tree, draw
from rosmop.tests.logics.test_mtl import Timed, timed_trace

PAST = ("previously", "once", "historically", "since")
FUTURE = ("next", "eventually", "always", "until")
ARITY = dict.fromkeys(("not", *PAST[:3], *FUTURE[:3]), 1)
PRINTER = Printer(
    {word: (word,) for word in (*PAST, *FUTURE)},
    [["since", "until"], ["and"], ["xor"], ["or"], ["implies", "iff"]],
    ["implies", "iff"],
)
OVER = 10**6

Truth = bool | None
At = Callable[[int, int], Truth]


def least(values: list[Truth]) -> Truth:
    return False if False in values else None if None in values else True


def most(values: list[Truth]) -> Truth:
    return negated(least([negated(value) for value in values]))


def negated(value: Truth) -> Truth:
    return None if value is None else not value


def worth(tree: Tree, trace: Timed, i: int, passed: int) -> Truth:
    """Return the truth at the event `i`, or None if it depends on what comes later than `passed`."""
    operator, *rest = tree
    bounds = rest.pop() if operator in (*PAST, *FUTURE) else (0, OVER)

    def at(operand: int, j: int) -> Truth:
        return worth(rest[operand], trace, j, passed)

    if operator == "event":
        return bool(trace[i][1] == rest[0])
    if operator in PAST:
        return of_the_past(operator, at, near(trace, i, bounds), i)
    if operator in FUTURE:
        high = OVER if bounds[1] is None else bounds[1]
        open_still: Truth = None if trace[i][0] + high > passed else False
        return of_the_future(operator, at, near(trace, i, bounds), range(i, len(trace)), open_still)
    return of_now(operator, [at(operand, i) for operand in range(len(rest))])


def near(trace: Timed, i: int, bounds: tuple[int, int | None]) -> Callable[[int], bool]:
    low, high = bounds
    return lambda j: low <= abs(trace[j][0] - trace[i][0]) <= (OVER if high is None else high)


def of_now(operator: str, values: list[Truth]) -> Truth:
    match operator, values:
        case (("true" | "false"), []):
            return operator == "true"
        case "not", [value]:
            return negated(value)
        case "and", _:
            return least(values)
        case "or", _:
            return most(values)
        case "implies", [left, right]:
            return most([negated(left), right])
        case (("xor" | "iff"), [left, right]):
            return None if left is None or right is None else (left != right) is (operator == "xor")
    raise AssertionError(operator)


def of_the_past(operator: str, at: At, near: Callable[[int], bool], i: int) -> Truth:
    past = range(i + 1)
    match operator:
        case "previously":
            return at(0, i - 1) if i > 0 and near(i - 1) else False
        case "once":
            return most([at(0, j) for j in past if near(j)])
        case "historically":
            return least([at(0, j) for j in past if near(j)])
        case "since":
            return most(
                [least([at(1, j), *(at(0, k) for k in range(j + 1, i + 1))]) for j in past if near(j)]
            )
    raise AssertionError(operator)


def of_the_future(
    operator: str, at: At, near: Callable[[int], bool], future: range, open_still: Truth
) -> Truth:
    i = future.start
    match operator:
        case "next":
            return open_still if i + 1 == future.stop else at(0, i + 1) if near(i + 1) else False
        case "eventually":
            return most([open_still, *(at(0, j) for j in future if near(j))])
        case "always":
            return least([negated(open_still), *(at(0, j) for j in future if near(j))])
        case "until":
            ways = [least([at(1, j), *(at(0, k) for k in range(i, j))]) for j in future if near(j)]
            return most([*ways, least([open_still, *(at(0, k) for k in future)])])
    raise AssertionError(operator)


def expected(tree: Tree, trace: Timed, end: int) -> list[tuple[int, str]]:
    record: list[tuple[int, str]] = []
    known: set[int] = set()

    def look(time: int, seen: Timed, passed: int) -> None:
        told = set()
        for i in range(len(seen)):
            if i not in known:
                value = worth(tree, seen, i, passed)
                if value is not None:
                    known.add(i)
                    told.add(value)
        record.extend(
            (time, word) for word, value in (("violation", False), ("validation", True)) if value in told
        )

    for place, (time, _) in enumerate(trace):
        seen = trace[: place + 1]
        look(time, seen, time - 1)
        following = trace[place + 1][0] if place + 1 < len(trace) else end
        for passed in range(time, following):
            look(passed, seen, passed)
    return record


def told(text: str, trace: Timed, end: int) -> list[tuple[int, str]]:
    record = play(compiled("mtl", text).start(0), ABC, trace, end)
    return [(time, category) for time, categories in record for category in categories]


def with_bounds(tree: Tree, random: Random) -> Tree:
    operands = tuple(with_bounds(part, random) if isinstance(part, tuple) else part for part in tree[1:])
    if tree[0] not in (*PAST, *FUTURE):
        return (tree[0], *operands)
    low = random.choice([0, 0, 1, 2])
    high = low + random.choice([0, 1, 2, 3])
    return (tree[0], *operands, (low, None if tree[0] in PAST and random.random() < 0.4 else high))


def is_about_the_future(tree: Tree) -> bool:
    return tree[0] in FUTURE or any(is_about_the_future(part) for part in tree[1:] if isinstance(part, tuple))


def rtamt_text(tree: Tree) -> str:
    """Return the formula for the other monitor, where a signal is 1 at its event, else -1."""
    operator, *rest = tree
    if operator == "event":
        return f"({rest[0]} >= 0)"
    bounds = "[{}:{}]".format(*rest.pop()) if operator in (*PAST, *FUTURE) else ""
    operands = [rtamt_text(operand) for operand in rest]
    if len(operands) == 1:
        return f"({operator}{bounds} {operands[0]})"
    return f"({operands[0]} {operator}{bounds} {operands[1]})"


def rtamt_knows(tree: Tree) -> bool:
    """Whether rtamt means the same: it takes `xor` and `iff` as distances, and `previously` as true at the start."""
    if tree[0] == "event":
        return True
    endless = tree[0] in PAST and tree[-1][1] is None
    if endless or tree[0] in ("true", "false", "previously", "next", "xor", "iff"):
        return False
    return all(rtamt_knows(part) for part in tree[1:] if isinstance(part[0], str))


@pytest.mark.skipif(
    sys.version_info >= (3, 12), reason="the parser of rtamt needs typing.io, which Python 3.12 has not"
)
def test_against_another_monitor() -> None:
    """With one event in each unit of time, the final value of a formula equals the other monitor's."""
    rtamt = importlib.import_module("rtamt")
    random = seeded(44)
    compared = 0
    while compared < 60:
        tree = with_bounds(draw(random, 3, (*PAST[1:], *FUTURE[1:]), ARITY, ("a", "b")), random)
        if not (rtamt_knows(tree) and is_about_the_future(tree)):
            continue
        compared += 1
        trace = [(time, random.choice(ABC)) for time in range(40)]
        other = rtamt.StlDiscreteTimeSpecification()
        for name in ("a", "b", "out"):
            other.declare_var(name, "float")
        other.spec = f"out = {rtamt_text(tree)}"
        other.parse()
        signals = {name: [1.0 if event == name else -1.0 for _, event in trace] for name in ("a", "b")}
        theirs = [value > 0 for _, value in other.evaluate({"time": [*range(40)], **signals})]
        # no formula of this depth looks more than fifteen units ahead
        ours = [worth(tree, trace, place, 40) for place in range(25)]
        assert ours == theirs[:25], PRINTER.show(tree, random)


def test_no_verdict_is_taken_back() -> None:
    random = seeded(43)
    for _ in range(300):
        tree = with_bounds(draw(random, 3, (*PAST, *FUTURE), ARITY, ("a", "b")), random)
        trace = timed_trace(random, 8, 3)
        final = [worth(tree, trace, i, 3 * OVER) for i in range(len(trace))]
        assert None not in final
        for place, (time, _) in enumerate(trace):
            for i in range(place + 1):
                early = worth(tree, trace[: place + 1], i, time - 1)
                assert early is None or early is final[i], (tree, trace)


def test_only_needed_values_are_kept() -> None:
    run = compiled("mtl", "eventually[0,9ns] a or eventually[0,1s] (b and next[0,1s] b)").start(0)
    run.step(ABC.index("c"), 0)
    waiting = run.deadline
    run.step(ABC.index("a"), 3)
    assert (waiting, run.deadline) == (9, None)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded.BoundedProperty, "most", 100)
    run = compiled("mtl", "a => eventually[0,1s] b").start(0)
    for time in range(100):
        assert run.step(0, time) == ()
    with pytest.raises(RunFaultError, match="more than 100 events"):
        run.step(0, 100)
    for _ in range(100):
        assert run.expire() == ("violation",)
    assert run.step(1, 3 * 10**9) == ("validation",)
    assert run.step(0, 3 * 10**9) == ()


@pytest.mark.parametrize(
    "text",
    [
        "always[0,2s] (a => eventually[0,1s] b)",
        "eventually[0,2s] (a and eventually[0,1s] b)",
        "(a => eventually[0,1s] b) until[0,2s] c",
        "(next[0,1s] a) until[1s,2s] eventually[0,1s] c",
    ],
)
@pytest.mark.parametrize("events", ["a", "ab", "b"])
def test_the_cost_of_a_step_does_not_grow_with_waiting_events(text: str, events: str) -> None:
    def lines_run(each_second: int) -> float:
        run, counted = compiled("mtl", text).start(0), 0

        def trace(frame: FrameType, event: str, _argument: object) -> Callable[..., Any] | None:
            nonlocal counted
            counted += event == "line"
            return trace if frame.f_code.co_filename == bounded.__file__ else None

        before = sys.gettrace()
        for number in range(4 * each_second):
            if number == 3 * each_second:
                sys.settrace(trace)
            time = number * 10**9 // each_second
            while (deadline := run.deadline) is not None and deadline < time:
                run.expire()
            run.step(ABC.index(events[number % len(events)]), time)
        sys.settrace(before)
        return counted / each_second

    assert lines_run(160) < 1.2 * lines_run(40) + 10


def test_deadlines_bring_no_verdict_that_may_drop() -> None:
    random = seeded(44)
    for _ in range(600):
        tree = with_bounds(draw(random, 3, (*PAST, *FUTURE), ARITY, ("a", "b")), random)
        monitor = compiled("mtl", PRINTER.show(tree, random))
        run = monitor.start(0)
        for time, event in timed_trace(random, 8, 6):
            while (deadline := run.deadline) is not None and deadline < time:
                assert all(monitor.blocking_refused(category) for category in run.expire()), monitor.formula
            run.step(ABC.index(event), time)


def test_an_undecided_part_that_is_not_needed_is_forgotten() -> None:
    text = (
        "next[0ns,1ns] previously[0ns,inf] (b -> a)"
        " or historically[0ns,inf] eventually[0ns,1ns] false and next[1ns,4ns] eventually[0ns,2ns] true"
    )
    part: Tree = ("previously", ("implies", ("event", "b"), ("event", "a")), (0, None))
    other: Tree = ("historically", ("eventually", ("false",), (0, 1)), (0, None))
    last: Tree = ("next", ("eventually", ("true",), (0, 2)), (1, 4))
    tree: Tree = ("or", ("next", part, (0, 1)), ("and", other, last))
    trace = list(zip((4, 4, 5, 5, 5, 5, 6, 7, 8), "cbbaaacbb", strict=True))
    assert told(text, trace, 40) == expected(tree, trace, 40)
