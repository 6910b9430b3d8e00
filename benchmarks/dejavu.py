"""Parametric specifications beside DejaVu's, on the traces of its own tests: `python -m benchmarks.dejavu CHECKOUT`.

CHECKOUT is DejaVu's repository (github.com/havelund/dejavu). Its tests state the events of each trace at which a
property fails; some of the traces are from the CRV benchmark challenge of 2018. The specifications here must report
the same events; otherwise the exit status is 1. The time of an event is that of all specifications together, in
microseconds of processor time. A trace that is not in the checkout is reported and skipped; without any, the exit
status is 2.

DejaVu quantifies over all values, whereas a slice has one binding. So a formula over two parameters that is a
conjunction of formulas over one is split into two specifications here (otherwise each user with each file would be a
slice). Properties with `exists` over values that no event binds together are not among the cases.
"""

import csv
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from roswire.standard import standard_definitions

SLICES = 100_000
TESTS = Path("src/test/scala")
_FIELDS = ("key", "value")


def specification(name: str, events: Mapping[str, Sequence[str]], over: Sequence[str], formula: str) -> str:
    """Return a specification. `events` has the names of each event's values, `over` the parameters."""
    lines = [
        f"event {event}({', '.join(f'std::string {value}' for value in values if value in over)}) /{event} "
        f"diagnostic_msgs/KeyValue "
        f"'{{{', '.join(f'{_FIELDS[values.index(one)]}:{one}' for one in values if one in over)}}}' {{ }}"
        for event, values in events.items()
        if any(value in over for value in values)
    ]
    head = f"{name}({', '.join(f'std::string {one}' for one in over)}) {{"
    return "\n".join([head, *lines, f"ptltl: {formula}", "@violation { }", "}"])


def of(events: Mapping[str, Sequence[str]], *properties: tuple[Sequence[str], str]) -> tuple[str, ...]:
    return tuple(
        specification(f"s{number}", events, over, formula)
        for number, (over, formula) in enumerate(properties)
    )


@dataclass(frozen=True)
class Case:
    """A trace and its specifications. `fails` has the events at which DejaVu reports a failure, counted from 1."""

    trace: str
    specifications: tuple[str, ...]
    fails: tuple[int, ...]


OPEN = "access => (!close S open)"
ACCESS = of(
    {"login": ("u",), "logout": ("u",), "open": ("f",), "close": ("f",), "access": ("u", "f")},
    (("u",), "access => (!logout S login)"),
    (("f",), OPEN),
)
SECURE = of(
    {"login": ("u",), "logout": ("u",), "open": ("f",), "close": ("f",), "access": ("u", "f")},
    (("u",), "access => (!logout S login)"),
    (("f",), f"({OPEN}) and (close => <*> open)"),
)
FILE = of({"open": ("f", "m"), "close": ("f",)}, (("f",), "close => (*)(!close S open)"))
LOCKS = of(
    {"acq": ("t", "l"), "rel": ("t", "l"), "sleep": ("t",)},
    (("t", "l"), "(sleep => !(!rel S acq)) and (rel => (*)(!rel S acq))"),
    # any acquirer: equivalent until the first failure, because until then only the lock's owner releases it
    (("l",), "acq => !(*)(!rel S acq)"),
)
COMMANDS = of({"dis": ("c", "n"), "suc": ("c", "n"), "err": ("n",)}, (("c", "n"), "suc => (!err S dis)"))
TWO = of({"p": ("z",), "q": ("y",), "r": ("y", "z")}, (("y", "z"), "r => (!q S p)"))
_FMSD = "tests_fmsd/property"
CASES = (
    *(Case(f"tests/test{number}/log1.csv", TWO, ()) for number in (6, 10)),
    *(Case(f"tests/test{number}/log2.csv", TWO, ()) for number in (6, 10)),
    *(Case(f"tests/test{number}/log3.csv", TWO, (5,)) for number in (6, 10)),
    Case("tests/test7/log1.csv", SECURE, (7, 9)),
    Case("tests/test7/log2.csv", SECURE, ()),
    Case("tests/test8/log1.csv", COMMANDS, ()),
    Case("tests/test8/log2.csv", COMMANDS, (7,)),
    Case("tests/test8/log3.csv", COMMANDS, (7, 8)),
    Case(f"{_FMSD}1-access/10,000/log-dejavu.txt", ACCESS, (11_006,)),
    Case(f"{_FMSD}1-access/100,000/log-dejavu.txt", ACCESS, (110_006,)),
    Case(f"{_FMSD}1-access/1,000,000/log-dejavu.txt", ACCESS, (1_100_006,)),
    Case(f"{_FMSD}2-file/10,000/log-dejavu.txt", FILE, (11_004,)),
    Case(f"{_FMSD}2-file/100,000/log-dejavu.txt", FILE, (110_004,)),
    Case(f"{_FMSD}2-file/1,000,000/log-dejavu.txt", FILE, (1_100_004,)),
    Case(f"{_FMSD}4-locks-basic/10,000/log-dejavu.txt", LOCKS, (10_401,)),
    Case(f"{_FMSD}4-locks-basic/100,000/log-dejavu.txt", LOCKS, (105_001,)),
    Case(f"{_FMSD}4-locks-basic/1,000,000/log-dejavu.txt", LOCKS, (1_050_126,)),
)


def messages(trace: Path) -> list[tuple[str, bytes]]:
    """Return the events as `diagnostic_msgs/KeyValue`, which have two values: no property uses a third."""
    found = []
    with trace.open(newline="") as rows:
        for name, *values in (row for row in csv.reader(rows) if row):
            texts = [one.strip().encode() for one in (*values, "", "")[:2]]
            found.append((f"/{name.strip()}", b"".join(struct.pack("<I", len(one)) + one for one in texts)))
    return found


def failing(specifications: Sequence[str], trace: Sequence[tuple[str, bytes]]) -> tuple[list[int], float]:
    sources = {f"{number}.rv": text for number, text in enumerate(specifications)}
    monitors = MonitorSet.of(compiled_from(sources, standard_definitions()), slices=SLICES)
    monitors.start(0)
    found = []
    started = time.process_time()
    for place, (topic, message) in enumerate(trace, 1):
        outcome = monitors.process(topic, message, place)
        if outcome.faults:
            raise SystemExit(f"event {place}: {outcome.faults[0].text}")
        if outcome.verdicts:
            found.append(place)
    return found, (time.process_time() - started) / len(trace) * 1e6


def main(checkout: Path) -> int:
    wrong = compared = 0
    for case in CASES:
        path = checkout / TESTS / case.trace
        if not path.is_file():
            print(f"{case.trace}: not in {checkout}")
            continue
        trace = messages(path)
        found, cost = failing(case.specifications, trace)
        same = found == list(case.fails)
        compared += 1
        wrong += not same
        said = "as DejaVu" if same else f"DejaVu says {list(case.fails)}"
        print(f"{case.trace}: {len(trace)} events, fails at {found}: {said}; {cost:.1f} µs an event")
    if not compared:
        print(f"{checkout} has no trace in {TESTS}: give a clone of DejaVu's repository", file=sys.stderr)
        return 2
    return int(wrong > 0)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        sys.exit(main(Path(sys.argv[1])))
    sys.exit(f"Nothing is compared without a checkout.\n\n{__doc__}")
