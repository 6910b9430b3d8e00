"""Learn in two passes over the training recordings, and one over the held-out part.

1. The first pass reads only times: the rhythm of each topic, and its order relative to other topics.
2. The second pass reads the fields of each message. Then the candidates are written as specifications.
3. The specifications run on the held-out recordings. A bound that was exceeded there is learnt again from all
   recordings, and so stays untested. Any other candidate with an alarm is left out.

Messages are never stored, so the memory depends only on the number of topics and fields.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from rosmop.check.sources import compiled_from
from rosmop.learn.candidates import Candidate, LearntFacts
from rosmop.learn.field_values import Fields, MessageError
from rosmop.learn.recordings import Received, RecordingPart, RecordingSource, Windows, split
from rosmop.learn.rv_writer import on, specifications
from rosmop.learn.topic_orders import TopicOrders
from rosmop.learn.topics import TopicContent, TopicRhythm
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from roswire.definitions import Definitions
from roswire.errors import DefinitionError

_WIDENS = frozenset({"range", "rate", "unchanged", "often", "late", "age", "requires", "causes"})
Progress = Callable[[int], None]


class LearningError(Exception):
    """Nothing can be learnt from these recordings; the text names them and the reason."""


@dataclass(frozen=True)
class LearningResult:
    """The result of learning.

    `alarms` counts the alarms of the text on the held-out recordings, as given in its comments.
    """

    text: str
    candidates: tuple[Candidate, ...]
    left_out: tuple[Candidate, ...]
    names: dict[tuple[str, str, str, int | None], str]
    """The specification of each candidate, by its key."""
    types: Mapping[str, str]
    """The message types of the topics."""
    trained: tuple[RecordingPart, ...]
    held_out: tuple[RecordingPart, ...]
    skipped: tuple[str, ...]
    """Topics whose type cannot be read, with the reason."""


def learn(
    recordings: Sequence[RecordingSource], definitions: Definitions, held_out: float, progress: Progress
) -> LearningResult:
    """Learn from recordings, but hold out the fraction `held_out`. `progress` gets the number of messages so far.

    Raises `LearningError`.
    """
    return _Learner(recordings, definitions, held_out, progress).learnt()


class _Learner:
    def __init__(
        self,
        recordings: Sequence[RecordingSource],
        definitions: Definitions,
        held_out: float,
        progress: Progress,
    ) -> None:
        self._definitions = definitions
        self._progress, self._seen = progress, 0
        self._trained, self._held_out = split(recordings, held_out)
        self._types = _types_of(recordings)
        self._fields: dict[str, Fields] = {}
        self._skipped: list[str] = []
        self._beats = Windows(len(self._trained))
        for topic, kind in sorted(self._types.items()):
            try:
                self._fields[topic] = Fields(definitions.layout(kind))
            except DefinitionError as error:
                self._skipped.append(f"{topic} ({kind}): {error}")

    def learnt(self) -> LearningResult:
        rhythms = {topic: TopicRhythm() for topic in self._fields}
        self._times(self._trained, rhythms)
        if not any(rhythm.count for rhythm in rhythms.values()):
            raise LearningError("the recordings to learn from have no message on any of these topics")
        known = self._contents(rhythms)
        candidates = list(known.candidates())
        rows = list(specifications(candidates, known))
        alarms = self._alarms(rows)
        self._continue(known)
        wider = {candidate.key: candidate for candidate in known.candidates()}
        kept, left_out = [], []
        for candidate in candidates:
            count = alarms[candidate.key]
            again = wider.get(candidate.key)
            if not count:
                kept.append(candidate)
            elif candidate.kind in _WIDENS and again is not None:
                why = f"WIDENED after {count} held-out alarms, so untested (it was {candidate.seen})"
                kept.append(replace(again, alarms=count, widened=why))
            else:
                left_out.append(replace(candidate, alarms=count))
        if not kept:
            raise LearningError(
                "no condition holds often enough in these recordings to propose it: record for longer"
            )
        rows = list(specifications(kept, known))
        names = {candidate.key: name for name, _, group in rows for candidate in group}
        text = "\n".join([self._head(known, kept, left_out), *(row[1] for row in rows)])
        compiled_from({"learnt.rv": text}, self._definitions)
        return LearningResult(
            text,
            tuple(kept),
            tuple(left_out),
            names,
            self._types,
            tuple(self._trained),
            tuple(self._held_out),
            tuple(self._skipped),
        )

    def _times(self, parts: Sequence[RecordingPart], rhythms: Mapping[str, TopicRhythm]) -> None:
        for part in parts:
            self._beats.enter(part)
            for rhythm in rhythms.values():
                rhythm.begin()
            for topic, time, _ in self._messages(part):
                rhythms[topic].add(time, self._beats.at(time), part.name)

    def _contents(self, rhythms: dict[str, TopicRhythm]) -> LearntFacts:
        contents = {
            topic: TopicContent(fields, rhythms[topic])
            for topic, fields in self._fields.items()
            if rhythms[topic].count
        }
        orders = TopicOrders({topic: rhythms[topic].count for topic in contents})
        known = LearntFacts(self._types, rhythms, contents, orders, Windows(len(self._trained)))
        for part in self._trained:
            self._observe(known, part)
        return known

    def _continue(self, known: LearntFacts) -> None:
        """Also learn from the held-out recordings, after the test."""
        self._times(self._held_out, known.rhythms)
        for part in self._held_out:
            self._observe(known, part)

    def _observe(self, known: LearntFacts, part: RecordingPart) -> None:
        known.windows.enter(part)
        known.orders.begin()
        for content in known.contents.values():
            content.begin()
        for topic, time, data in self._messages(part):
            if topic not in known.contents:  # the topic is only in the held-out recordings
                continue
            window = known.windows.at(time)
            try:
                known.contents[topic].add(data, time, window)
            except MessageError as error:
                kind = self._types[topic]
                raise LearningError(
                    f"{part.name}: a message on {topic} is not of type {kind}: {error}"
                ) from error
            known.orders.add(topic, time, window)

    def _messages(self, part: RecordingPart) -> Iterator[Received]:
        for topic, time, data in part.messages():
            self._seen += 1
            self._progress(self._seen)
            if topic in self._fields:
                yield topic, time, data

    def _alarms(
        self, rows: Sequence[tuple[str, str, list[Candidate]]]
    ) -> Counter[tuple[str, str, str, int | None]]:
        """Return how often each candidate warned on the held-out recordings."""
        found: Counter[tuple[str, str, str, int | None]] = Counter()
        groups = {name: group for name, _, group in rows}
        text = "\n".join(row[1] for row in rows)
        for part in self._held_out if rows else ():
            monitors = MonitorSet.of(compiled_from({"learnt.rv": text}, self._definitions))
            monitors.start(part.began, frozenset(part.topics))
            for topic, time, data in self._messages(part):
                outcome = monitors.process(topic, data, time)
                for each in (*outcome.before, outcome):
                    found.update(_warned(each, groups))
        return found

    def _head(self, known: LearntFacts, kept: Sequence[Candidate], left_out: Sequence[Candidate]) -> str:
        seconds = sum(part.seconds for part in self._trained)
        held = sum(part.seconds for part in self._held_out)
        lines = [
            "Learnt from recordings; edit it: its conditions held in them, but may not be required.",
            "It warns and drops nothing: write DROP; or return; where a message shall not pass.",
            f"Learnt from {seconds:.0f} s: {_names(self._trained)}.",
            f"Tested on {held:.0f} s that were held out: {_names(self._held_out)}."
            if self._held_out
            else "Nothing was held out: it is untested.",
        ]
        if self._held_out:
            widened = sum(1 for candidate in kept if candidate.widened)
            lines.append(
                f"{len(kept) - widened} conditions gave no alarm there; {widened} did and were widened, "
                f"{len(left_out)} did and were left out" + (":" if left_out else ".")
            )
        lines += [
            f"  {candidate.topic} {candidate.says} ({candidate.seen}): {candidate.alarms} alarms; "
            f"{on(candidate.support)}"
            for candidate in left_out
        ]
        lines += [f"Not looked at: {text}" for text in self._skipped]
        lines += [
            f"{count} conditions more on {topic} are not here: they are many"
            for topic, count in known.trimmed.items()
        ]
        if known.orders.left_out:
            lines.append(f"Not compared with other topics: {', '.join(known.orders.left_out)}")
        return "".join(f"// {' '.join(line.split())}\n" for line in lines)


def _names(parts: Sequence[RecordingPart]) -> str:
    most = 6
    names = [part.name for part in parts]
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _types_of(recordings: Sequence[RecordingSource]) -> dict[str, str]:
    types: dict[str, str] = {}
    for recording in recordings:
        for topic, kind in recording.topics.items():
            other = types.setdefault(topic, kind)
            if other != kind:
                raise LearningError(
                    f"{topic} carries {other} in one recording and {kind} in {recording.name}"
                )
    return types


def _warned(outcome: Outcome, groups: dict[str, list[Candidate]]) -> list[tuple[str, str, str, int | None]]:
    found = []
    for line in outcome.log:
        if line.level != "WARN":
            continue
        for candidate in groups.get(line.monitor, ()):
            if line.text == f"{candidate.topic} {candidate.says}" or line.text.startswith(
                f"{candidate.topic} {candidate.says}: "
            ):
                found.append(candidate.key)
    return found
