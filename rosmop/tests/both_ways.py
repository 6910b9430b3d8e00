"""Compare the fast path of a set with the interpreter: for any message both must do the same."""

import struct
from collections import Counter
from collections.abc import Iterable

from rosmop.check.sources import compiled_from
from rosmop.fast.abi import AREA
from rosmop.logics.interface import ClockedRun, FiniteRun
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.fast_path import FastLane
from rosmop.run.outcomes import Verdict, label_of
from rosmop.runtime.action_context import LogLine, Published
from rosmop.tests.interpreted import beside
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import definitions

STAMPED = struct.pack("<I3sIIdhI2dBI", 3, b"abc", 9, 8, 2.5, 1, 2, 0.5, 7.0, 1, 0)


def plain(count: int = 0, x: float = 0.0, kind: int = 0, rest: bytes = b"") -> bytes:
    return struct.pack("<BidfBII3qI", kind, count, x, 0.0, 0, 5, 7, 1, 2, 3, len(rest)) + rest


def stamped(
    frame: bytes = b"abc", count: int = 0, names: tuple[bytes, ...] = (), values: tuple[float, ...] = ()
) -> bytes:
    body = struct.pack("<I", len(frame)) + frame + struct.pack("<IIdhI", 9, 8, 2.5, count, len(values))
    body += struct.pack(f"<{len(values)}dBI", *values, 0, len(names))
    return body + b"".join(struct.pack("<I", len(name)) + name for name in names)


def frames(bodies: Iterable[bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(body)) + body for body in bodies)


class BothWays:
    def __init__(self, *texts: str, on_fault: OnFault = "drop", margins: bool = False) -> None:
        sources = {f"{place}.rv": text for place, text in enumerate(texts)}
        self.monitors = on_module(compiled_from(sources, definitions(), margins=margins), on_fault)
        self.interpreter = beside(self.monitors)
        for one in (self.monitors, self.interpreter):
            one.start(0)
            for monitor in one.monitors:
                monitor.seen = True
        self.came: Counter[str] = Counter()
        self.told: list[Verdict] = []
        self.interpreted: list[Verdict] = []
        self.counts: Counter[str] = Counter()
        self.lines: list[LogLine] = []
        self.published: list[Published] = []
        self.counting = False
        self._inside = False
        """Whether messages are in the module's memory; this changes with each check."""

    def lane(self, topic: str = "/plain") -> FastLane:
        found = self.monitors.lane(topic)
        assert found is not None
        return found

    def check(self, bodies: list[bytes], topic: str = "/plain", time: int = 1) -> list[bytes]:
        expected = []
        began, self.counts = len(self.interpreted), Counter()
        lines: list[LogLine] = []
        published: list[Published] = []
        for body in bodies:
            outcome = self.interpreter.process(topic, bytearray(body), time)
            self.interpreted += (verdict for each in (*outcome.before, outcome) for verdict in each.verdicts)
            lines += (line for each in (*outcome.before, outcome) for line in each.log)
            published += (one for each in (*outcome.before, outcome) for one in each.published)
            self.came[outcome.result if not outcome.faults else "fault"] += 1
            if outcome.result != "dropped":
                expected.append(bytes(outcome.buffer))
        self._inside = not self._inside
        told, self.lines, self.published = len(self.told), [], []
        assert self._fed(frames(bodies), topic, time) == frames(expected)
        assert self.counts + Counter(map(label_of, self.told[told:])) == Counter(
            map(label_of, self.interpreted[began:])
        )
        assert self.lines == lines
        assert self.published == published
        assert self.counting or self.told[told:] == self.interpreted[began:]
        assert self.state() == state_of(self.interpreter)
        return expected

    def state(self) -> list[str]:
        return state_of(self.monitors)

    def _fed(self, given: bytes, topic: str, time: int) -> bytes:
        view, area = memoryview(bytearray(given)), self.monitors.area
        if self._inside and area is not None and len(given) <= AREA:
            view = area[: len(given)]
            view[:] = given
        pieces: list[memoryview | bytes] = []
        position = run = 0
        lane = self.monitors.lane(topic)
        while position < len(view):
            if lane is not None and self.monitors.lane_ready(lane, time):
                before = position
                counted = [self.counting] * len(lane.verdicts)
                prepared = lane.prepare(loud=False, told=(), counted=counted)
                walked = lane.process_batch(view, position, run, pieces, time, prepared)
                for verdict, count in zip(lane.verdicts, walked.told if walked else (), strict=False):
                    self.counts[label_of(verdict)] += count
                self.lines += (line for _, line in walked.output) if walked else ()
                position, run = (len(view), run) if walked is None else (walked.position, walked.run)
                self.came["together"] += position > before
                if position == len(view):
                    break
            first = position + 4
            following = first + int.from_bytes(view[position:first], "little")
            body = view[first:following]
            outcome = self.monitors.process(topic, body, time)
            self.told += (one for each in (*outcome.before, outcome) for one in each.verdicts)
            self.lines += (line for each in (*outcome.before, outcome) for line in each.log)
            self.published += (one for each in (*outcome.before, outcome) for one in each.published)
            if outcome.result == "dropped":
                pieces.append(view[run:position])
                run = following
            elif outcome.buffer is not body:
                pieces += (view[run:position], frames([bytes(outcome.buffer)]))
                run = following
            position = following
        return b"".join([*pieces, view[run:]])


def state_of(monitors: MonitorSet) -> list[str]:
    state = []
    for monitor in monitors.monitors:
        names = monitors.interpreter.variables
        state += [f"{name} {names.get(code)!r}" for name, code in monitor.code.variables.items()]
        noted = (name for comparison in monitor.code.comparisons for name in comparison.variables)
        state += [f"{name} {names[name]!r}" for name in noted]
        state += [str(one.run.state) for one in monitor.properties if isinstance(one.run, FiniteRun)]
        clocked = [one.run for one in monitor.properties if isinstance(one.run, ClockedRun)]
        state += [f"{run.state} since {run.since} at {run.now}" for run in clocked]
    return state


def event(
    body: str, parameters: str = "int count", pattern: str = "count:count", before: str = "int n = 0;"
) -> str:
    return f"s() {{ {before} event e({parameters}) /plain own/Plain '{{{pattern}}}' {{ {body} }} }}"
