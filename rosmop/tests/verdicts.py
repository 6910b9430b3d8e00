"""Compare verdicts with the definitions of the logics, on all short traces and on random ones, of random properties.

    .venv/bin/python -m rosmop.tests.verdicts [TRACES] [--seed SEED] [--logic LOGIC]   # default: a million

The tests of each logic define the meaning of a property, from the definition alone (`rosmop/tests/logics`);
parametric specifications are one specification for each binding (`rosmop/tests/test_slices.py`). For each property
all short traces and some random ones are judged, with every verdict on the way. Each logic has the same share of the
random traces. Parametric specifications have a hundredth of it, because each of their traces is judged once for each
binding. Differences are printed with property and trace, and the exit status is 1.
"""

import argparse
import functools
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

from rosmop.tests import test_slices as slices
from rosmop.tests.acting import load
from rosmop.tests.logics import fsm_definition as fsm
from rosmop.tests.logics import test_bounded as bounded
from rosmop.tests.logics import test_cfg as cfg
from rosmop.tests.logics import test_ere as ere
from rosmop.tests.logics import test_ltl as ltl
from rosmop.tests.logics import test_mtl as mtl
from rosmop.tests.logics import test_pattern as pattern
from rosmop.tests.logics import test_ptcaret as ptcaret
from rosmop.tests.logics import test_ptltl as ptltl
from rosmop.tests.logics import test_srs as srs
from rosmop.tests.logics import test_tfsm as tfsm
from rosmop.tests.logics.driving import ABC, compiled, play, seeded, told, traces
from rosmop.tests.logics.temporal import draw

_EACH = 50


@dataclass(frozen=True)
class Drawn:
    text: str
    short: Sequence[Any]
    long: Callable[[], Any]
    told: Callable[[Any], object]
    meant: Callable[[Any], object]


def _untimed(
    logic: str,
    text: str,
    meant: Callable[[tuple[str, ...]], object],
    random: Random,
    *,
    events: Sequence[str] = ABC,
    longest: tuple[int, int] = (4, 12),
) -> Drawn:
    monitor = compiled(logic, text, events)
    return Drawn(
        text,
        list(traces(events, longest[0])),
        lambda: tuple(random.choices(events, k=random.randint(1, longest[1]))),
        lambda trace: told(monitor, trace),
        meant,
    )


def _prefixes(trace: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    return (trace[:length] for length in range(1, len(trace) + 1))


def _true(values: Sequence[bool]) -> list[tuple[str, ...]]:
    return [("validation",) if value else ("violation",) for value in values]


def _timed(events: Sequence[str], longest: int, last: int) -> list[mtl.Timed]:
    return [
        list(zip(times, names, strict=True))
        for length in range(1, longest + 1)
        for times in itertools.combinations_with_replacement(range(last + 1), length)
        for names in itertools.product(events, repeat=length)
    ]


def _fsm(random: Random) -> Drawn:
    written = fsm.Written(random)
    text = written.text(random)
    assert {*compiled("fsm", text).categories} == {*written.states, *written.aliases, "fail"}
    return _untimed("fsm", text, lambda trace: [*map(written.after, _prefixes(trace))], random)


def _ere(random: Random) -> Drawn:
    tree = ere.draw(random, 3)
    text = ere.show(tree, random)
    monitor = compiled("ere", text)
    return Drawn(
        text,
        list(traces(ABC, 4)),
        lambda: tuple(random.choices(ABC, k=random.randint(1, 9))),
        lambda trace: [verdict == ("match",) for verdict in told(monitor, trace)],
        lambda trace: [ere.member(tree, prefix) for prefix in _prefixes(trace)],
    )


def _cfg(random: Random) -> Drawn:
    rules = cfg.draw(random)
    return _untimed(
        "cfg",
        cfg.show(rules, random),
        lambda trace: [cfg.expected(rules, prefix) for prefix in _prefixes(trace)],
        random,
        longest=(3, 7),
    )


def _ptltl(random: Random) -> Drawn:
    tree = draw(random, 3, ptltl.TEMPORAL, ptltl.ARITY, ("a", "b"))
    return _untimed(
        "ptltl",
        ptltl.PRINTER.show(tree, random),
        lambda trace: _true([ptltl.holds(tree, trace, place) for place in range(len(trace))]),
        random,
    )


def _ptcaret(random: Random) -> Drawn:
    tree = draw(random, 3, ptcaret.TEMPORAL, ptcaret.UNARY, ptcaret.EVENTS)
    return _untimed(
        "ptcaret",
        ptcaret.show(tree),
        lambda trace: ptcaret.verdicts(tree, trace),
        random,
        events=ptcaret.EVENTS,
    )


def _ltl(random: Random) -> Drawn:
    arity = ltl.UNARY | dict.fromkeys(("previously", "once", "historically", "dual previously"), 1)
    operators: tuple[str, ...] = (*ltl.TEMPORAL, *ltl.PAST)
    events: tuple[str, ...] = ltl.AB
    stem = 4
    if random.random() < 0.1:  # dear: with an event that the formula does not name
        operators, events, stem = ltl.TEMPORAL, (*ltl.AB, "x"), 3
    tree = draw(random, 3, operators, arity, ltl.AB)
    while not ltl.has(tree, ltl.TEMPORAL):
        tree = draw(random, 3, operators, arity, ltl.AB)
    text = ltl.PRINTER.show(tree, random)
    monitor = compiled("ltl", text, events)

    def meant(trace: tuple[str, ...], loop: int = 2) -> list[tuple[str, ...]]:
        """Return the common verdict of continuations; if it differs from the report, also try longer loops."""
        found = continued(loop)
        said = [found[prefix] for prefix in _prefixes(trace)]
        return said if loop == 5 or said == told(monitor, trace) else meant(trace, loop + 1)

    @functools.cache
    def continued(loop: int) -> dict[tuple[str, ...], tuple[str, ...]]:
        return ltl.by_enumeration(tree, [ltl.unrolled(one, 6) for one in ltl.lassos(events, stem, loop)], 3)

    return _untimed("ltl", text, meant, random, events=events, longest=(3, 3))


def _srs(random: Random) -> Drawn:
    rules = srs.draw(random)

    def meant(trace: tuple[str, ...]) -> list[tuple[str, ...]]:
        string, verdict, said = list[str](), tuple[str, ...](), []
        for event in trace:
            if not verdict:
                string, verdict = srs.rewritten(rules, [*string, event])
            said.append(verdict)
        return said

    return _untimed("srs", srs.show(rules), meant, random)


def _tfsm(random: Random) -> Drawn:
    written = tfsm.Ticking(random)
    machine = compiled("tfsm", written.text(), tfsm.AB)
    return Drawn(
        written.text(),
        _timed(tfsm.AB, 3, 4),
        lambda: [
            (when, random.choice(tfsm.AB))
            for when in sorted(random.choices(range(20), k=random.randint(1, 8)))
        ],
        lambda trace: play(machine.start(0), tfsm.AB, trace, 25),
        lambda trace: written.play(trace, 0, 25),
    )


def _mtl(random: Random) -> Drawn:
    tree = mtl.bounded(draw(random, 3, mtl.TEMPORAL, mtl.ARITY, ("a", "b")), random, 6)
    text = mtl.PRINTER.show(tree, random)
    monitor = compiled("mtl", text)
    return Drawn(
        text,
        _timed(ABC, 3, 2),
        lambda: mtl.timed_trace(random, random.randint(1, 10), 5),
        lambda trace: mtl.verdicts(monitor.start(0), trace),
        lambda trace: [mtl.holds(tree, trace, place) for place in range(len(trace))],
    )


def _future(random: Random) -> Drawn:
    operators = (*bounded.PAST, *bounded.FUTURE, *bounded.FUTURE)
    tree = bounded.with_bounds(draw(random, 3, operators, bounded.ARITY, ("a", "b")), random)
    while not bounded.is_about_the_future(tree):
        tree = bounded.with_bounds(draw(random, 3, operators, bounded.ARITY, ("a", "b")), random)
    text = bounded.PRINTER.show(tree, random)
    return Drawn(
        text,
        _timed(("a", "b"), 3, 2),
        lambda: mtl.timed_trace(random, random.randint(1, 7), 3),
        lambda trace: bounded.told(text, trace, trace[-1][0] + 20),
        lambda trace: bounded.expected(tree, trace, trace[-1][0] + 20),
    )


def _pattern(random: Random) -> Drawn:
    meaning = random.choice(_PATTERNS)
    monitor = compiled("pattern", meaning.text())
    return Drawn(
        meaning.text(),
        _FEW_TIMED,
        lambda: tuple(
            (when, random.choice(ABC)) for when in sorted(random.choices(range(13), k=random.randint(1, 4)))
        ),
        lambda trace: play(monitor.start(0), ABC, trace, 20),
        lambda trace: pattern.told_by(meaning, trace, 20),
    )


_PATTERNS = pattern.meanings(ABC, (None, 0, 3))
_FEW_TIMED = [tuple(trace) for trace in _timed(ABC, 2, 4)]


def _slices(random: Random) -> Drawn:
    made = slices.made(random)

    def said(trace: slices.Trace) -> list[slices.Told]:
        monitors = load(made.text(binding=True))
        return [
            slices.told(monitors.process(f"/{event}", slices.body(values), place))
            for place, (event, values) in enumerate(trace)
        ]

    return Drawn(
        made.text(binding=True),
        [],
        lambda: slices.trace(random, random.randint(1, 12)),
        said,
        lambda trace: slices.naive(made, trace),
    )


LOGICS: dict[str, Callable[[Random], Drawn]] = {
    "fsm": _fsm, "tfsm": _tfsm, "ere": _ere, "cfg": _cfg, "ltl": _ltl, "ptltl": _ptltl, "mtl": _mtl,
    "mtl about the future": _future, "pattern": _pattern, "ptcaret": _ptcaret, "srs": _srs, "parametric": _slices,
}  # fmt: skip


def differing(
    logic: str, count: int, seed: int, *, each: int = _EACH, short: int | None = None
) -> Iterator[tuple[int, str]]:
    """Yield, for each property, how many traces were judged and the first difference, or an empty string.

    Properties are drawn until `count` random traces are judged: `each` of a property, with `short` of its short
    traces (all by default).
    """
    random = seeded(seed)
    left = count
    while left > 0:
        drawn = LOGICS[logic](random)
        chosen = [drawn.long() for _ in range(min(each, left))]
        left -= len(chosen)
        wrong = ""
        few = drawn.short if short is None else random.sample(drawn.short, min(short, len(drawn.short)))
        for trace in (*few, *chosen):
            said, meant = drawn.told(trace), drawn.meant(trace)
            if said != meant:
                wrong = f"{drawn.text}\non {trace}\nsays  {said}\nmeans {meant}\n"
                break
        yield len(few) + len(chosen), wrong


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("traces", type=int, nargs="?", default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--logic", choices=LOGICS)
    options = parser.parse_args(arguments)
    wrong = 0
    share = options.traces if options.logic else -(-options.traces // (len(LOGICS) - 1))
    for logic in [options.logic] if options.logic else LOGICS:
        count = -(-share // 100) if logic == "parametric" else share
        started, judged = time.process_time(), 0
        for traces_of, difference in differing(logic, count, options.seed):
            judged += traces_of
            if difference:
                wrong += 1
                sys.stdout.write(f"{logic}: {difference}")
        spent = time.process_time() - started
        sys.stdout.write(f"{logic}: {judged} traces, {spent:.0f} s\n")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
