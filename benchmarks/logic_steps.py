"""The cost of one step of a monitor, per logic, on traces of a thousand and a million events.

    python -m benchmarks.logic_steps [--long EVENTS] [--beside]

The cost must not grow with the trace or with a time bound. The loop around the step is subtracted. For logics with
tables, the last column is the cost of looking them up inline. `--beside` compares `mtl` formulas about the past with
reelay and rtamt in this process, with one event for each unit of time.
"""

import argparse
import gc
import time
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import reelay
import rtamt

from rosmop.form.findings import Position
from rosmop.logics.catalogue import compile_property
from rosmop.logics.interface import CompiledProperty, FiniteProperty, Run

EVENTS = ("a", "b", "c")
MS = 1_000_000

PROPERTIES = (
    ("fsm", "s0 [ a -> s1, default s0 ] s1 [ b -> s0, default s1 ]", "mixed"),
    ("tfsm", "s0 [ a -> s1, default s0 ] s1 [ b -> s0, default s1, timeout 1h -> s0 ]", "mixed"),
    ("ere", "(a | b c* & ~(a a))* (a | b | c)*", "mixed"),
    ("ltl", "[](a => o (!c or <> b))", "mixed"),
    ("ptltl", "a => (!c S b)", "mixed"),
    ("ptltl", " xor ".join("(*) " * n + "a" for n in range(1, 16)), "mixed"),
    ("cfg", "S -> S a | S b | S c | epsilon", "mixed"),
    ("cfg", "S -> S a S b | epsilon", "pairs"),
    ("cfg", "S -> a S b S | epsilon", "pairs"),
    ("cfg", "S -> S S | a S b | a b", "pairs"),
    ("cfg", "S -> a S b | epsilon", "nested"),
    ("mtl", "a => once[0,500ms] b", "mixed"),
    ("mtl", "a => once[0,24h] b", "mixed"),
    ("mtl", "!c since[10ms,20ms] a", "mixed"),
    ("mtl", "!c since[10s,20s] a", "mixed"),
    ("mtl", "once[1s,1s] a", "mixed"),
    ("mtl", "a => eventually[0,24h] b", "mixed"),
    ("mtl", "a => !b until[10ms,24h] c", "mixed"),
    ("mtl", "historically (a => eventually[0,24h] b)", "mixed"),
    ("mtl", "once[0,20ms] eventually[0,24h] a", "mixed"),
    ("pattern", "globally: a forbids c within 1ns", "mixed"),
    ("pattern", "after a until c: a causes b within 1h", "mixed"),
)

BESIDE = (
    ("a => once[0,500ns] b", "({a} -> once[0:500] {b})", "((a >= 0) implies (once[0:500] (b >= 0)))"),
    ("!c since[10ns,20ns] a", "((!{c}) since[10:20] {a})", "((not (c >= 0)) since[10:20] (a >= 0))"),
    ("historically[0,50ns] (c => once[0,100ns] a)", "(historically[0:50] ({c} -> once[0:100] {a}))",
     "(historically[0:50] ((c >= 0) implies (once[0:100] (a >= 0))))"),
)  # fmt: skip
"""Each formula in this language, in reelay's and in rtamt's."""


def trace(kind: str, length: int) -> list[int]:
    """Return random events, pairs that nest at most two deep, or all openings before all closings."""
    if kind == "pairs":
        return [0, 0, 1, 1, 0, 1] * (length // 6)
    if kind == "nested":
        return [0] * (length // 2) + [1] * (length // 2)
    return Random(1).choices(range(len(EVENTS)), k=length)


def per_step(run: Run, events: Sequence[int]) -> float:
    """Return the nanoseconds of a step, with events one millisecond apart."""
    step = run.step
    times = range(0, len(events) * MS, MS)
    gc.collect()
    start = time.perf_counter_ns()
    for event, now in zip(events, times, strict=True):
        step(event, now)
    spent = time.perf_counter_ns() - start
    start = time.perf_counter_ns()
    for _event, _now in zip(events, times, strict=True):
        pass
    return (spent - (time.perf_counter_ns() - start)) / len(events)


def inline_step(compiled: CompiledProperty, events: Sequence[int]) -> float | None:
    if not isinstance(compiled, FiniteProperty):
        return None
    table, verdicts, state = compiled.automaton.table, compiled.automaton.verdicts, compiled.automaton.initial
    told = 0
    start = time.perf_counter_ns()
    for event in events:
        state = table[state][event]
        if verdicts[state]:
            told += 1
    spent = time.perf_counter_ns() - start
    start = time.perf_counter_ns()
    for _event in events:
        pass
    return (spent - (time.perf_counter_ns() - start)) / len(events)


def others(for_reelay: str, for_rtamt: str, events: Sequence[int]) -> tuple[Callable[[int], bool], ...]:
    """Return the steps of reelay and rtamt. Each returns whether the formula holds at an event."""
    other: Any = reelay.discrete_timed_monitor(pattern=for_reelay, semantics="boolean", condense=False)
    third = rtamt.StlDiscreteTimeSpecification()
    for name in (*EVENTS, "out"):
        third.declare_var(name, "float")
    third.spec = f"out = {for_rtamt}"
    third.parse()
    told = [{name: number == event for number, name in enumerate(EVENTS)} for event in events]
    signals = [[(name, 1.0 if so else -1.0) for name, so in one.items()] for one in told]
    return (
        lambda now: bool(other.update(told[now])["value"]),
        lambda now: bool(third.update(now, signals[now]) > 0),
    )


def beside(events: Sequence[int]) -> None:
    print(f"{'here':>8} {'reelay':>8} {'rtamt':>8}  ns/step, {len(events)} events")
    for formula, for_reelay, for_rtamt in BESIDE:
        compiled = compile_property("mtl", formula, EVENTS, Position("benchmark", 1, 1))
        start = time.process_time_ns()
        run = compiled.start(0)
        verdicts = [[run.step(event, now) == ("validation",) for now, event in enumerate(events)]]
        costs = [(time.process_time_ns() - start) / len(events)]
        for step in others(for_reelay, for_rtamt, events):
            start = time.process_time_ns()
            verdicts.append([step(now) for now in range(len(events))])
            costs.append((time.process_time_ns() - start) / len(events))
        if not verdicts[0] == verdicts[1] == verdicts[2]:
            raise SystemExit(f"{formula}: the verdicts differ")
        print(f"{costs[0]:8.0f} {costs[1]:8.0f} {costs[2]:8.0f}  {formula}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", type=int, default=1_000_000, help="events of the long trace")
    parser.add_argument("--beside", action="store_true", help="reelay and rtamt, on 20,000 events")
    options = parser.parse_args()
    if options.beside:
        beside(trace("mixed", 20_000))
        return
    lengths = (1_000, options.long)
    print(f"{'logic':8} {'ns/step':>8} {'ns/step':>8} {'inline':>7}  formula (trace)")
    print(f"{'':8} {lengths[0]:>8} {lengths[1]:>8}")
    for logic, formula, kind in PROPERTIES:
        compiled = compile_property(logic, formula, EVENTS, Position("benchmark", 1, 1))
        per_step(compiled.start(0), trace(kind, 1_000))
        costs = [per_step(compiled.start(0), trace(kind, length)) for length in lengths]
        inline = inline_step(compiled, trace(kind, lengths[-1]))
        shown = formula if len(formula) < 60 else formula[:57] + "…"
        inlined = "" if inline is None else f"{inline:.0f}"
        print(f"{logic:8} {costs[0]:8.0f} {costs[1]:8.0f} {inlined:>7}  {shown} ({kind})")


if __name__ == "__main__":
    main()
