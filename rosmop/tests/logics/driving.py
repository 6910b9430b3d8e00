from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from random import Random

from rosmop.form.findings import Position
from rosmop.logics.catalogue import compile_property
from rosmop.logics.interface import CompiledProperty, FormulaError, Run


def seeded(seed: int) -> Random:
    return Random(seed)  # noqa: S311  # draws examples, not keys


ORIGIN = Position("test.rv", 7, 11)
ABC = ("a", "b", "c")


def compiled(logic: str, formula: str, events: Sequence[str] = ABC) -> CompiledProperty:
    return compile_property(logic, formula, events, ORIGIN)


def told(compiled: CompiledProperty, trace: Iterable[str]) -> list[tuple[str, ...]]:
    run = compiled.start(0)
    return [run.step(compiled.events.index(event), 0) for event in trace]


def play(
    run: Run, events: Sequence[str], trace: Iterable[tuple[int, str]], end: int = 0
) -> list[tuple[int, tuple[str, ...]]]:
    record = []
    for time, event in trace:
        record += _expired(run, time)
        record.append((time, run.step(events.index(event), time)))
    return record + _expired(run, end)


def _expired(run: Run, time: int) -> list[tuple[int, tuple[str, ...]]]:
    record = []
    while (deadline := run.deadline) is not None and deadline < time:
        record.append((deadline, run.expire()))
    return record


def traces(events: Sequence[str], longest: int) -> Iterator[tuple[str, ...]]:
    for length in range(1, longest + 1):
        yield from product(events, repeat=length)


def refusal(logic: str, formula: str, events: Sequence[str] = ABC) -> list[str]:
    try:
        compile_property(logic, formula, events, ORIGIN)
    except FormulaError as error:
        return [f"{f.position.line}:{f.position.column}: {f.text}" for f in error.findings]
    raise AssertionError(f"{formula!r} was accepted")
