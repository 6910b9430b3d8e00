"""Learn in two passes over all recordings, and one over the held-out part.

1. The first pass reads only times: the rhythm of each topic.
2. The second pass reads the fields, and the order of topics. The candidates of the training recordings become
   specifications.
3. The specifications run on the held-out recordings. A bound that was exceeded there is learnt again from all
   recordings, and so stays untested. Any other candidate with an alarm is left out.

Messages are never stored, so the memory depends only on the number of topics and fields.
"""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, groupby
from typing import Any

from rosmop.check.sources import compiled_from
from rosmop.learn.candidates import (
    CPP,
    WORDS,
    Candidate,
    CandidateSupport,
    LearntFacts,
    escape,
    identifier,
    number,
    one_line,
    short_names,
)
from rosmop.learn.field_values import Fields
from rosmop.learn.passes import (
    AlarmFacts,
    AlarmStep,
    AnyStep,
    ContentFacts,
    ContentStep,
    Facts,
    Run,
    TimeFacts,
    TimeStep,
    named_files,
)
from rosmop.learn.recordings import LearnedSpan, LearningError, RecordingFacts, split
from rosmop.learn.topic_orders import TopicOrders
from rosmop.learn.topics import MAX_GAPS, TopicContent, TopicRhythm
from rosmop.text.parser import MAX_CHARACTERS
from roswire.counted import counted
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.names import is_global_name, is_valid_type_name

# Write candidates as `.rv` text that a person edits: a specification for each topic, one for each order.

_TOLD_EVERY = "1.0"  # seconds
_WIDTH = 104  # the maximum number of columns of a statement


def specifications(
    candidates: Sequence[Candidate], known: LearntFacts
) -> Iterator[tuple[str, str, list[Candidate]]]:
    taken: set[str] = set()
    own = [candidate for candidate in candidates if not candidate.events]
    for topic, group in groupby(own, key=lambda candidate: candidate.topic):
        rows, name = list(group), _new_name(topic, taken)
        yield name, _topic(name, rows, known), rows
    for candidate in candidates:
        if candidate.events:
            name = _new_name(f"{candidate.topic}_{candidate.kind}_{candidate.path}", taken)
            yield name, _order(name, candidate, known.types), [candidate]


def _new_name(text: str, taken: set[str]) -> str:
    name = identifier(text)
    name = f"{name}_topic" if name in WORDS else name
    free = name if name not in taken else next(f"{name}_{n}" for n in count(2) if f"{name}_{n}" not in taken)
    taken.add(free)
    return free


def on(support: CandidateSupport) -> str:
    messages, recordings = counted(support.messages, "message"), counted(support.recordings, "recording")
    return f"{messages}, {support.seconds:g} s, {recordings}"


def _topic(name: str, rows: list[Candidate], known: LearntFacts) -> str:
    checks = [row for row in rows if not row.formula]
    names = short_names(dict.fromkeys(row.path for row in checks if row.path))
    topic = rows[0].topic
    kind, kinds, period = known.types[topic], known.fields[topic], known.rhythms[topic].period
    parameters = ", ".join(f"{_parameter(kinds[path])} {short}" for path, short in names.items())
    fields = ", ".join(f"{path}:{short}" for path, short in names.items())
    lines = [f"// {topic} ({kind}): {on(rows[0].support)}.", f"{name}() {{"]
    scalars = [row for row in checks if not row.folded]
    declared = _once(piece for row in scalars for piece in _fill(row, row.state, names))
    first = _once(piece for row in scalars for piece in _fill(row, row.first, names))
    then = _once(piece for row in scalars for piece in _fill(row, row.then, names))
    own = f"{known.short[topic]}_"
    timed = any("elapsed" in row.condition for row in checks)
    begun = any("begun" in text for row in checks for text in (row.condition, *row.first))
    clock = timed or any("now" in text for row in checks for text in (row.condition, *row.first))
    state = [*declared, *["double {t}before = 0.0;"] * timed, *["bool {t}begun = false;"] * begun]
    lines += [f"    {line.replace('{t}', own)}" for line in state] + [""] * bool(state)
    lines += _wrap(f"    event message({parameters}) {topic} {kind}")
    lines += _wrap(f"            '{{{fields}}}' {{")
    body = ["double now = ros::Time::now().toSec();"] * clock
    if timed:
        body.append(f"double elapsed = std::max(now - {{t}}before, {number(period)});")
    body += first
    for row in scalars:
        body += _check(row, names)
    for _, group in groupby((row for row in checks if row.folded), key=lambda row: row.path):
        body += _loop(list(group), names)
    body += [*then, *["{t}before = now;"] * timed, *["{t}begun = true;"] * begun]
    lines += [f"        {line.replace('{t}', own)}" for line in body] + ["    }"]
    for row in rows:
        if row.formula:
            lines += ["", *(f"    {line}" for line in _property(row))]
    return "\n".join([*lines, "}", ""])


def _order(name: str, candidate: Candidate, types: Mapping[str, str]) -> str:
    lines = [f"// {' and '.join(sorted(candidate.topics))}: {on(candidate.support)}.", f"{name}() {{"]
    for event, (topic, pattern) in candidate.events.items():
        lines.append(f"    event {event}() {topic} {types[topic]} '{{{pattern}}}' {{ }}")
    return "\n".join([*lines, "", *(f"    {line}" for line in _property(candidate)), "}", ""])


def _property(row: Candidate) -> list[str]:
    category = "fail" if row.formula.startswith("fsm") else "violation"
    return [_comment(row), row.formula, f'@{category} {{ ROS_WARN("{row.topic} {row.says}"); __RESET; }}']


def _check(row: Candidate, names: Mapping[str, str]) -> list[str]:
    (condition,) = _fill(row, (row.condition,), names)
    size = f"{_short(row, names)}.size()"
    if row.length is not None and row.element is None:
        condition = f"{size} != {row.length} || {condition}"
    elif row.length is not None:
        condition = f"{size} == {row.length} && ({condition})"
    lines = _alarm(condition, [_warning(row, names)])
    # The condition of a constant needs no comment.
    return lines if row.kind == "constant" and not row.widened else [_comment(row), *lines]


def _loop(rows: list[Candidate], names: Mapping[str, str]) -> list[str]:
    lines = [_comment(row) for row in rows] + [
        f"for (int i = 0; i < {_short(rows[0], names)}.size(); i++) {{"
    ]
    for row in rows:
        (condition,) = _fill(row, (row.condition,), names)
        lines += [f"    {line}" for line in _alarm(condition, [_warning(row, names), "break;"])]
    return [*lines, "}"]


def _alarm(condition: str, statements: Sequence[str]) -> list[str]:
    line = f"if ({condition}) {{ {' '.join(statements)} }}"
    if len(line) <= _WIDTH:
        return [line]
    return [f"if ({condition}) {{", *(f"    {statement}" for statement in statements), "}"]


def _warning(row: Candidate, names: Mapping[str, str]) -> str:
    text = f"{escape(row.topic)} {escape(row.says)}"
    if not row.shown:
        return f'ROS_WARN_THROTTLE({_TOLD_EVERY}, "{text}");'
    (shown,) = _fill(row, (row.shown,), names)
    form = "%s" if shown.endswith("c_str()") else "%ld" if shown.startswith("(long)") else "%g"
    return f'ROS_WARN_THROTTLE({_TOLD_EVERY}, "{text}: {form}", {shown});'


def _comment(row: Candidate) -> str:
    text = f"// {row.place or row.topic}: {row.seen}"
    if row.widened:
        text += f"; {row.widened}"
    return one_line(text)


def _wrap(line: str) -> list[str]:
    indent = " " * 12
    return textwrap.wrap(line, 118, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def _once(pieces: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(pieces))


def _fill(row: Candidate, texts: Iterable[str], names: Mapping[str, str]) -> list[str]:
    value = _short(row, names)
    name = value
    if row.element is not None:
        value, name = f"{value}[{row.element}]", f"{value}_{row.element}"
    elif row.folded:
        value = f"{value}[i]"
    filled = [text.replace("{v}", value).replace("{n}", name) for text in texts]
    if row.element is None:
        return filled
    guard = f"if ({_short(row, names)}.size() == {row.length}) {{ "
    return [f"{guard}{text} }}" if value in text and text.endswith((";", "}")) else text for text in filled]


def _short(row: Candidate, names: Mapping[str, str]) -> str:
    return names.get(row.path, "")


def _parameter(kind: str) -> str:
    if kind in ("time", "duration"):
        return f"ros::{kind.capitalize()}"
    if kind == "length":
        return "auto"
    name = kind.removesuffix("[]")
    return f"std::vector<{CPP[name]}>" if kind.endswith("[]") else CPP[name]


_WIDENS = frozenset({"range", "rate", "unchanged", "often", "late", "age", "requires", "causes"})
_WINDOWS = 24  # the minimum number for all recordings together


@dataclass(frozen=True)
class LearningResult:
    """The learnt specifications as the texts of files, their candidates, and the candidates that were left out."""

    texts: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    left_out: tuple[Candidate, ...]
    names: dict[tuple[str, str, str, int | None], str]
    types: Mapping[str, str]
    trained: tuple[LearnedSpan, ...]
    held_out: tuple[LearnedSpan, ...]
    skipped: tuple[str, ...]
    failed: Mapping[int, str]

    @property
    def text(self) -> str:
        return "".join(self.texts)


def pack(pieces: Iterable[str]) -> tuple[str, ...]:
    """Return as few texts as fit in files, with these pieces in their order."""
    texts = [""]
    for piece in pieces:
        if len(texts[-1]) + len(piece) > MAX_CHARACTERS:
            texts.append("")
        texts[-1] += piece
    return tuple(texts)


def learn(
    recordings: Sequence[RecordingFacts], definitions: Definitions, held_out: float, run: Run
) -> LearningResult:
    """Learn from all but the fraction `held_out`, which tests the result. `run` executes the passes."""
    return _Learner(recordings, definitions, held_out, run).learnt()


class _Learner:
    def __init__(
        self, recordings: Sequence[RecordingFacts], definitions: Definitions, held_out: float, run: Run
    ) -> None:
        self._definitions = definitions
        self._run = run
        self._trained, self._held_out = split(recordings, held_out)
        self._each = math.ceil(_WINDOWS / max(len(self._trained), 1))
        self._types = _types_of(recordings)
        self._fields: dict[str, Mapping[str, str]] = {}
        self._skipped: list[str] = []
        self._failed: dict[int, str] = {}
        for topic, kind in sorted(self._types.items()):
            if not is_global_name(topic) or not is_valid_type_name(kind):
                self._skipped.append(f"{topic} ({kind}): not a valid name")
                continue
            try:
                found = Fields(definitions.layout(kind)).types
            except DefinitionError as error:
                self._skipped.append(f"{topic} ({kind}): {error}")
                continue
            self._fields[topic] = {
                path: of for path, of in found.items() if not WORDS.intersection(path.split("."))
            }
            self._skipped += [
                f"{path} of {topic} ({kind}): specifications cannot name it, as they have this word"
                for path in found
                if path not in self._fields[topic]
            ]

    def learnt(self) -> LearningResult:
        tested, whole = self._facts()
        candidates = list(tested.candidates())
        alarms = self._alarms(candidates, tested) if candidates else AlarmFacts()
        wider = {candidate.key: candidate for candidate in whole.candidates()}
        kept, left_out = [], []
        for position, candidate in enumerate(candidates):
            count = alarms.alarms.get(position, 0)
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
        rows = list(specifications(kept, whole))
        names = {candidate.key: name for name, _, group in rows for candidate in group}
        texts = pack([*self._head(whole, kept, left_out), *(f"\n{row[1]}" for row in rows)])
        compiled_from(named_files(texts), self._definitions)
        return LearningResult(
            texts,
            tuple(kept),
            tuple(left_out),
            names,
            self._types,
            tuple(self._trained),
            tuple(self._held_out),
            tuple(self._skipped),
            self._failed,
        )

    def _facts(self) -> tuple[LearntFacts, LearntFacts]:
        times = [
            TimeStep(*self._span(place), gaps=math.ceil(MAX_GAPS / len(self._trained)))
            for place in range(len(self._parts))
        ]
        trained, every = self._pass(times, TimeFacts())
        rhythms = dict(sorted(trained.rhythms.items()))
        if not rhythms:
            raise LearningError("the recordings to learn from have no message on any of these topics")
        orders = TopicOrders({topic: rhythm.count for topic, rhythm in rhythms.items()})
        periods = {topic: (rhythm.period, rhythm.interval) for topic, rhythm in rhythms.items()}
        # A topic that is only in the held-out recordings has no rhythm.
        contents = [
            ContentStep(*self._span(place, rhythms), rhythms=periods, ordered=list(orders.names))
            for place in range(len(self._parts))
        ]
        content, contents_of_all = self._pass(contents, ContentFacts())
        return (
            self._known(trained, content, orders, len(self._trained)),
            self._known(every, contents_of_all, orders, len(self._parts)),
        )

    def _known(
        self, times: TimeFacts, contents: ContentFacts, orders: TopicOrders, parts: int
    ) -> LearntFacts:
        own = TopicOrders({})
        own.names, own.left_out, own.pairs = orders.names, orders.left_out, dict(orders.pairs)
        own.add_recordings(contents.pairs)
        rows: dict[str, TopicContent] = {
            topic: contents.contents[topic] for topic in self._fields if topic in contents.contents
        }
        rhythms: dict[str, TopicRhythm] = times.rhythms
        seconds = sum(part.seconds for part in self._parts[:parts] if part.number not in self._failed)
        return LearntFacts(self._types, self._fields, rhythms, rows, own, seconds, parts * self._each)

    @property
    def _parts(self) -> list[LearnedSpan]:
        return [*self._trained, *self._held_out]

    def _span(
        self, place: int, topics: Mapping[str, object] | None = None
    ) -> tuple[int, int, int, int, int, dict[str, str]]:
        part = self._parts[place]
        chosen = {topic: self._types[topic] for topic in self._fields if topics is None or topic in topics}
        return part.number, part.began, part.ended, place * self._each, self._each, chosen

    def _pass(self, steps: Sequence[AnyStep], nothing: Facts) -> tuple[Any, Any]:
        trained: Any = nothing  # the type of facts that this pass collects
        held_out: Any = nothing
        waiting = [step for step in steps if step.recording not in self._failed]
        for place, facts in self._run(waiting):
            step = waiting[place]
            if isinstance(facts, LearningError):
                self._failed[step.recording] = str(facts)
            elif step.first_window < len(self._trained) * self._each:
                trained = trained.merge(facts)
            else:
                held_out = held_out.merge(facts)
        if self._failed.keys() >= {part.number for part in self._trained}:
            raise LearningError(next(iter(self._failed.values())))
        return trained, trained.merge(held_out)

    def _alarms(self, candidates: Sequence[Candidate], known: LearntFacts) -> AlarmFacts:
        rows = list(specifications(candidates, known))
        numbers = {candidate.key: number for number, candidate in enumerate(candidates)}
        says = {
            name: [(numbers[candidate.key], f"{candidate.topic} {candidate.says}") for candidate in group]
            for name, _, group in rows
        }
        texts = pack(f"\n{row[1]}" for row in rows)
        held_out = range(len(self._trained), len(self._parts))
        steps = [AlarmStep(*self._span(place), texts=texts, says=says) for place in held_out]
        alarms: AlarmFacts = self._pass(steps, AlarmFacts())[1]
        return alarms

    def _head(
        self, known: LearntFacts, kept: Sequence[Candidate], left_out: Sequence[Candidate]
    ) -> Iterator[str]:
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
        lines += [f"Not, or only partly, learnt from: {text}" for _, text in sorted(self._failed.items())]
        lines += [f"Not looked at: {text}" for text in self._skipped]
        lines += [
            f"{count} conditions more on {topic} are not here: they are many, or long"
            for topic, count in known.trimmed.items()
        ]
        if known.orders.left_out:
            lines.append(f"Not compared with other topics: {', '.join(known.orders.left_out)}")
        return (f"// {one_line(line)}\n" for line in lines)


def _names(parts: Sequence[LearnedSpan]) -> str:
    most = 6
    names = [part.name for part in parts]
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _types_of(recordings: Sequence[RecordingFacts]) -> dict[str, str]:
    types: dict[str, str] = {}
    for recording in recordings:
        for topic, kind in recording.topics.items():
            other = types.setdefault(topic, kind)
            if other != kind:
                raise LearningError(
                    f"{topic} carries {other} in one recording and {kind} in {recording.name}"
                )
    return types
