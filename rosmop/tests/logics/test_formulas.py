"""Tables of formulas: verdicts on traces, errors, and facts known before they run.

    ltl: a => <> b ==> b -> validation                  the verdict after each event; `-` is none
    mtl: once[5ns,inf] a ==> 3ns a, 9ns -> 3ns …        with times: each verdict with its own; the last time is the end
    pattern: until a: no b ==> deadlines bring          the categories that may follow a passed bound
    fsm: s [ a -> s ==> 7:21: expected …                the findings; the formula begins at 7:11

The events are a, b and c, or those of a line with `+` before the formula; in `facts.txt` it has the handled
categories.
"""

from pathlib import Path

from rosmop.logics.catalogue import compile_property
from rosmop.logics.interface import CompiledProperty, FormulaError
from rosmop.logics.property_lint import analyse, shortest_trace_to
from rosmop.tests.logics.driving import ABC, ORIGIN, compiled, play, told
from rosmop.tests.transcripts import Case, table

TABLES = Path(__file__).parent
UNITS = {"s": 10**9, "ms": 10**6, "ns": 1}


@table(TABLES / "formulas.txt")
def test_a_formula_gives_these_verdicts_or_is_rejected(case: Case) -> None:
    assert judged(case) == case.expected


@table(TABLES / "facts.txt")
def test_these_facts_are_known_of_a_formula_before_it_runs(case: Case) -> None:
    assert facts_of(case) == case.expected


def judged(case: Case) -> tuple[str, ...]:
    logic, _, formula = case.source.partition(": ")
    try:
        monitor = compile_property(logic, formula, tuple(case.beside.split()) or ABC, ORIGIN)
    except FormulaError as error:
        return tuple(f"{one.position.line}:{one.position.column}: {one.text}" for one in error.findings)
    late = " ".join(category for category in monitor.categories if monitor.blocking_refused(category))
    traces = (line.partition(" -> ")[0] for line in case.expected)
    return tuple(
        f"deadlines bring {late}".rstrip()
        if trace.startswith("deadlines")
        else f"{trace} -> {verdicts(monitor, trace)}"
        for trace in traces
    )


def verdicts(monitor: CompiledProperty, trace: str) -> str:
    if not trace[0].isdigit():
        return ", ".join("+".join(categories) or "-" for categories in told(monitor, trace.split()))
    steps = [step.partition(" ") for step in trace.split(", ")]
    events = [(nanoseconds(time), event) for time, _, event in steps if event]
    record = play(monitor.start(0), monitor.events, events, nanoseconds(steps[-1][0]))
    return (
        ", ".join(f"{shown(time)} {'+'.join(categories)}" for time, categories in record if categories) or "-"
    )


def nanoseconds(text: str) -> int:
    number = text.rstrip("msn")
    return int(number) * UNITS[text.removeprefix(number)]


def shown(time: int) -> str:
    return next(f"{time // size}{unit}" for unit, size in UNITS.items() if time % size == 0)


def facts_of(case: Case) -> tuple[str, ...]:
    logic, _, formula = case.source.partition(": ")
    monitor = compiled(logic, formula)
    asked = [line.partition(" by ")[0] for line in case.expected if " by " in line]
    if asked:
        return tuple(f"{one} by {' '.join(shortest_trace_to(monitor, one) or ())}" for one in asked)
    facts = analyse(monitor, case.beside.split())
    return tuple(f"{fact.kind}: {fact.category}" for fact in facts) or ("nothing",)
