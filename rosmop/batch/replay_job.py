"""Run specifications on one recording, and summarize their effects."""

from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import msgspec

from rosmop.batch.recording_list import RecordingName
from rosmop.check.sources import compiled_from
from rosmop.fast.build import fast_path_of
from rosmop.recordings.recording import OWN, Reader, definitions_of, open_recording
from rosmop.recordings.replay import ReplayStep, refusals, replay
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.outcomes import Outcome, Verdict, binding, why_of
from rosmop.run.slices import LIMIT
from rosmop.run.why_lines import lines_of_why
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

KINDS = ("drop", "change", "verdict", "warning", "fault")
_LONGEST = 4096  # characters of the text of an effect


class Specifications(msgspec.Struct, frozen=True):
    """Specifications by file name, and message and service definitions by file name (`package/Type.msg`).

    With `chosen`, only this monitor runs, with those that share its variables. `topics` and `given` replace
    values of the texts, by monitor and name. `on_fault` and `slices` are settings of the appliance.
    """

    texts: dict[str, str]
    definitions: dict[str, str]
    chosen: str | None = None
    topics: dict[str, dict[str, str]] = msgspec.field(default_factory=dict)
    given: dict[str, dict[str, bool | int | float | str]] = msgspec.field(default_factory=dict)
    on_fault: OnFault = "drop"
    slices: int = LIMIT

    def merge(self, recorded: Definitions) -> Definitions:
        """Return the definitions of the recording, of ROS, and the given ones; later ones replace earlier ones."""
        own = standard_definitions().merge(Definitions.from_files(self.definitions))
        return recorded.merge(own)

    def monitors(self, recorded: Definitions, *, margins: bool = False) -> MonitorSet:
        compiled = compiled_from(self.texts, self.merge(recorded), margins=margins, topics=self.topics)
        fast = fast_path_of(compiled) if find_spec("wasmtime") is not None else None
        monitors: MonitorSet = MonitorSet.of(
            compiled,
            self.on_fault,
            fast=fast,
            slices=self.slices,
            holder_of=lambda source: monitors.interpreter.turn.names(source)[0] or None,
        )
        monitors.give(self.given)
        if self.chosen is not None:
            (together,) = compiled.groups([self.chosen])
            monitors.switch({name: name in together for name in monitors.names}, 0)
        return monitors


class ReplayJob(msgspec.Struct, frozen=True, tag=True):
    """Runs specifications on the topics that match a pattern, between two times in nanoseconds.

    Monitors published the recorded messages of the node `own`.
    The first `most` occurrences are kept for each monitor, topic and kind. Messages of another
    type are dropped; if the job is `strict`, a topic that has no others is an error.
    """

    recording: RecordingName
    specifications: Specifications
    topics: list[str]
    span: tuple[int, int]
    most: int
    margins: bool
    strict: bool
    own: str = OWN


class EffectCount(msgspec.Struct, frozen=True):
    """How often a monitor had an effect of a kind on a topic or timer; times are in nanoseconds."""

    monitor: str
    kind: str
    place: str
    count: int
    first: int
    last: int


class Occurrence(msgspec.Struct, frozen=True):
    """One effect: its time in nanoseconds, and the topic and number of the message, or the timer."""

    monitor: str
    kind: str
    time: int
    topic: str | None
    index: int | None
    timer: str | None
    text: str


class ClosestMargin(msgspec.Struct, frozen=True):
    """The smallest distance of a comparison while it was true (`holds`) or false, and where it occurred."""

    file: str
    line: int
    column: int
    number: int
    monitor: str
    holds: bool
    distance: float
    left: float
    right: float
    threshold_at: float | None
    time: int
    index: int | None


class Replayed(msgspec.Struct, frozen=True, tag=True):
    """The effects on one recording: all are counted, and the first are listed. `notes` are reasons of drops."""

    messages: int
    passed: int
    changed: int
    dropped: int
    effects: list[EffectCount]
    occurrences: list[Occurrence]
    margins: list[ClosestMargin]
    notes: list[str]


class Found(NamedTuple):
    """An effect of a monitor."""

    monitor: str
    kind: str
    text: str


def replay_recording(job: ReplayJob, path: Path) -> Replayed:
    with closing(open_recording(path)) as reader:
        monitors = job.specifications.monitors(definitions_of(reader), margins=job.margins)
        strict = job.recording.uri if job.strict else None
        notes = refusals(monitors, reader, job.topics, own=job.own, strict=strict)
        return _Summary(job).of(monitors, reader, notes)


class _Summary:
    def __init__(self, job: ReplayJob) -> None:
        self._job = job
        self._effects: dict[tuple[str, str, str], EffectCount] = {}
        self._occurrences: list[Occurrence] = []
        self._closest: dict[tuple[str, int, int, int, bool], ClosestMargin] = {}

    def of(self, monitors: MonitorSet, reader: Reader, notes: list[str]) -> Replayed:
        counts = {"passed": 0, "changed": 0, "dropped": 0}
        for step in replay(monitors, reader, None, self._job.topics, self._job.span, own=self._job.own):
            if step.index is not None:
                counts[step.outcome.result] += 1
            for found in _found(step.outcome):
                self._add(step, found)
            if self._job.margins:
                self._add_margins(monitors, step)
        return Replayed(
            sum(counts.values()), counts["passed"], counts["changed"], counts["dropped"], list(self._effects.values()),
            self._occurrences, [margin for _key, margin in sorted(self._closest.items())], notes,
        )  # fmt: skip

    def _add(self, step: ReplayStep, found: Found) -> None:
        time, timer = step.outcome.time, step.outcome.timer
        key = found.monitor, step.topic or timer or "", found.kind
        known = self._effects.get(key)
        count, first = (1, time) if known is None else (known.count + 1, known.first)
        self._effects[key] = EffectCount(found.monitor, found.kind, key[1], count, first, time)
        if count <= self._job.most:
            text = found.text[:_LONGEST].encode("utf-8", "backslashreplace").decode("utf-8")
            place = (time, step.topic, step.index, timer)
            self._occurrences.append(Occurrence(found.monitor, found.kind, *place, text))

    def _add_margins(self, monitors: MonitorSet, step: ReplayStep) -> None:
        for margin in monitors.take_margins():
            position = margin.position
            place = position.file, position.line, position.column
            key = (*place, margin.number, not margin.holds)
            known = self._closest.get(key)
            if known is None or margin.distance < known.distance:
                self._closest[key] = ClosestMargin(
                    *place, margin.number, margin.monitor, margin.holds, margin.distance, margin.left, margin.right,
                    margin.threshold_at, step.outcome.time, step.index,
                )  # fmt: skip


def _found(outcome: Outcome) -> Iterator[Found]:
    said = {line.monitor: line.text for line in outcome.log}
    if outcome.result == "dropped":
        why = outcome.reason or (outcome.fatal.text if outcome.fatal is not None else "")
        yield Found(outcome.dropped_by, "drop", why or said.get(outcome.dropped_by) or outcome.events[-1])
    for monitor in dict.fromkeys(event.partition(".")[0] for event in outcome.changed_by):
        own = [event for event in outcome.changed_by if event.startswith(f"{monitor}.")]
        yield Found(monitor, "change", ", ".join(own))
    for verdict in outcome.verdicts:
        text = f"{verdict.category} of property {verdict.property + 1} ({verdict.logic}){binding(verdict)}"
        yield Found(verdict.monitor, "verdict", "; ".join((text, *because(verdict))))
    for line in outcome.log:
        if line.level not in ("DEBUG", "INFO"):
            yield Found(line.monitor, "warning", line.text)
    for fault in outcome.faults:
        yield Found(fault.monitor, "fault", f"{fault.position}: {fault.text}")


def because(verdict: Verdict) -> Iterator[str]:
    return lines_of_why(why_of(verdict, place_of).get("why", {}))


def place_of(source: int) -> dict[str, int]:
    return {"index": source - 1}
