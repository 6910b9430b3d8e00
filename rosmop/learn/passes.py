"""The passes of learning over one recording, and the merging of their results.

Merging is associative and commutative, so the recordings may be read in any order, and anywhere.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import msgspec

from rosmop.check.sources import compiled_from
from rosmop.learn.field_values import Fields, MessageError
from rosmop.learn.recordings import LearningError, Received, RecordingSource
from rosmop.learn.series import merged_rows
from rosmop.learn.topic_orders import TopicOrderReader, TopicPair
from rosmop.learn.topics import TopicContent, TopicContentReader, TopicRhythm
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from roswire.definitions import Definitions


def named_files(texts: Sequence[str], stem: str = "learnt", suffix: str = ".rv") -> dict[str, str]:
    """Return texts by the names of their files: `learnt.rv`, `learnt_2.rv`, …"""
    return {f"{stem}_{n}{suffix}" if n > 1 else f"{stem}{suffix}": text for n, text in enumerate(texts, 1)}


class LearningStep(msgspec.Struct, frozen=True, tag=True):
    """The part of a recording from `began` to `ended` (nanoseconds), and the topics to read.

    It has `windows` windows; the first has the number `first_window`.
    """

    recording: int
    began: int
    ended: int
    first_window: int
    windows: int
    topics: dict[str, str]

    def messages(self, source: RecordingSource) -> Iterator[tuple[Received, int]]:
        length = self.ended - self.began + 1
        for message in source.messages():
            if message[0] in self.topics and self.began <= message[1] <= self.ended:
                yield message, self.first_window + (message[1] - self.began) * self.windows // length


class TimeStep(LearningStep, frozen=True):
    """Reads only times. The median of a topic's gaps is taken from at most `gaps` of them."""

    gaps: int


class ContentStep(LearningStep, frozen=True):
    """Reads fields. `rhythms` has the period and the interval of each topic, in seconds."""

    rhythms: dict[str, tuple[float, float]]
    ordered: list[str]


class AlarmStep(LearningStep, frozen=True):
    """Runs the learnt specifications. `says` has a candidate's number and how its warning begins, by monitor."""

    texts: tuple[str, ...]
    says: dict[str, list[tuple[int, str]]]


class TimeFacts(msgspec.Struct, frozen=True, tag=True):
    """The rhythm of each topic."""

    rhythms: dict[str, TopicRhythm] = {}

    def merge(self, other: "TimeFacts") -> "TimeFacts":
        return TimeFacts(merged_rows(self.rhythms, other.rhythms, TopicRhythm.merge))


class ContentFacts(msgspec.Struct, frozen=True, tag=True):
    """The fields and the order of topics."""

    contents: dict[str, TopicContent] = {}
    pairs: dict[tuple[str, str], TopicPair] = {}

    def merge(self, other: "ContentFacts") -> "ContentFacts":
        return ContentFacts(
            merged_rows(self.contents, other.contents, TopicContent.merge),
            merged_rows(self.pairs, other.pairs, TopicPair.merge),
        )


class AlarmFacts(msgspec.Struct, frozen=True, tag=True):
    """The alarms by candidate, for candidates that have some."""

    alarms: dict[int, int] = {}

    def merge(self, other: "AlarmFacts") -> "AlarmFacts":
        return AlarmFacts(merged_rows(self.alarms, other.alarms, int.__add__))


Facts = TimeFacts | ContentFacts | AlarmFacts
AnyStep = TimeStep | ContentStep | AlarmStep


def facts_of(step: AnyStep, source: RecordingSource, definitions: Definitions) -> Facts:
    if isinstance(step, TimeStep):
        return _times(step, source)
    if isinstance(step, ContentStep):
        return _contents(step, source, definitions)
    return _alarms(step, source, definitions)


def _times(step: TimeStep, source: RecordingSource) -> TimeFacts:
    rhythms: dict[str, TopicRhythm] = {}
    for (topic, time, _data), window in step.messages(source):
        if topic not in rhythms:
            rhythms[topic] = TopicRhythm()
            rhythms[topic].begin(step.recording, step.first_window)
        rhythms[topic].add(time, window, step.gaps)
    for rhythm in rhythms.values():
        rhythm.end()
    return TimeFacts(rhythms)


def _contents(step: ContentStep, source: RecordingSource, definitions: Definitions) -> ContentFacts:
    contents = {
        topic: TopicContentReader(Fields(definitions.layout(kind)), *step.rhythms[topic])
        for topic, kind in step.topics.items()
    }
    orders = TopicOrderReader(step.ordered)
    for (topic, time, data), window in step.messages(source):
        try:
            contents[topic].add(data, time, window)
        except MessageError as error:
            text = f"{source.name}: a message on {topic} is not of type {step.topics[topic]}: {error}"
            raise LearningError(text) from error
        orders.add(topic, time, window)
    return ContentFacts({topic: content.finish() for topic, content in contents.items()}, orders.finish())


def _alarms(step: AlarmStep, source: RecordingSource, definitions: Definitions) -> AlarmFacts:
    found: dict[int, int] = {}
    monitors = MonitorSet.of(compiled_from(named_files(step.texts), definitions))
    monitors.start(step.began, frozenset(source.topics))
    for outcome in _outcomes(monitors, step, source):
        for number in _warned(outcome, step.says):
            found[number] = found.get(number, 0) + 1
    return AlarmFacts(found)


def _outcomes(monitors: MonitorSet, step: AlarmStep, source: RecordingSource) -> Iterator[Outcome]:
    for (topic, time, data), _window in step.messages(source):
        outcome = monitors.process(topic, data, time)
        yield from (*outcome.before, outcome)
    yield from monitors.advance(step.ended)


def _warned(outcome: Outcome, says: Mapping[str, list[tuple[int, str]]]) -> Iterator[int]:
    for line in outcome.log:
        if line.level == "WARN":
            for number, text in says.get(line.monitor, ()):
                if line.text == text or line.text.startswith(f"{text}: "):
                    yield number


def run_here(sources: Sequence[RecordingSource], definitions: Definitions) -> "Run":
    def run(steps: list[AnyStep]) -> Iterator[tuple[int, Facts | LearningError]]:
        for number, step in enumerate(steps):
            try:
                yield number, facts_of(step, sources[step.recording], definitions)
            except LearningError as error:
                yield number, error

    return run


Run = Callable[[list[AnyStep]], Iterator[tuple[int, Facts | LearningError]]]
"""Executes steps, and yields each number with the facts, or with the reason of the failure, in any order."""
