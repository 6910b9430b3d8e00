"""Report the effects of monitors: lines and tables for people, rows for programs."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple, Self

from rich.table import Column

from rosmop.batch.jobs import Failure
from rosmop.batch.replay_job import KINDS, ClosestMargin, Occurrence, Replayed
from rosmop.form.findings import Position, line_of
from rosmop.tool.monitor_output import BILLION
from rosmop.tool.tables import add_row, say_table, table_of
from rosmop.tool.terminal import say, say_json
from roswire.counted import counted

MAX_IN_ROWS = 10_000
_MAX_RECORDINGS = 100  # lines of the table of recordings
_WOULD = {"drop": "would drop it", "change": "would change it"}
_HEADS = ("would drop", "would change", "verdicts", "warnings", "faults")


class ReplayReport:
    """Collects the results of recordings in their order."""

    def __init__(self, most: int, *, as_json: bool) -> None:
        self.failures: list[Failure] = []
        self.messages = 0
        self._most = most
        self._as_json = as_json
        self._counts: Counter[tuple[str, str, str]] = Counter()
        self._said: Counter[tuple[str, str, str]] = Counter()
        self._recordings: list[_Line] = []
        self._closest: dict[tuple[Position, int, bool], tuple[ClosestMargin, str]] = {}

    def add(self, recording: str, result: Replayed | Failure) -> list[dict[str, object]]:
        rows = self._print(_rows(recording, result))
        self._recordings.append(_Line.of(recording, result))
        if isinstance(result, Failure):
            self.failures.append(result)
            return rows
        self.messages += result.messages
        for note in () if self._as_json else result.notes:
            say(f"{recording}: {note}; its messages are dropped", "yellow")
        for occurrence in result.occurrences:
            self._say(recording, occurrence)
        for effect in result.effects:
            self._counts[effect.monitor, effect.place, effect.kind] += effect.count
        for margin in result.margins:
            key = Position(margin.file, margin.line, margin.column), margin.number, not margin.holds
            if key not in self._closest or margin.distance < self._closest[key][0].distance:
                self._closest[key] = margin, recording
        return rows

    def show(self, texts: Mapping[str, str]) -> list[dict[str, object]]:
        closest = [row for _key, row in sorted(self._closest.items())]
        rows = self._print(_margin_row(margin, recording) for margin, recording in closest)
        if self._as_json:
            return rows
        self._show_counts()
        if len(self._recordings) > 1:
            self._show_recordings()
        for margin, recording in closest:
            say(_margin_line(margin, recording, line_of(texts[margin.file], margin.line)))
        say(f"{counted(self.messages, 'message')} of {counted(len(self._recordings), 'recording')}")
        return rows

    def _print(self, rows: Iterable[dict[str, object]]) -> list[dict[str, object]]:
        printed = list(rows)
        for row in printed if self._as_json else ():
            say_json(row)
        return printed

    def _say(self, recording: str, found: Occurrence) -> None:
        where = found.topic or found.timer or ""
        key = found.monitor, where, found.kind
        self._said[key] += 1
        if not self._as_json and self._said[key] <= self._most:
            place = where if found.index is None else f"#{found.index} {where}"
            words = _WOULD.get(found.kind, found.kind)
            say(f"{recording} {found.time / BILLION:.3f} {place}: {found.monitor} {words}: {found.text}")

    def _show_counts(self) -> None:
        counts = self._counts
        if not counts:
            if len(self.failures) < len(self._recordings):
                alone = "with these monitors alone, no message would have been dropped or changed"
                say(f"{alone}, and no monitor reached a verdict", "green")
            return
        columns = (Column(head, justify="right") for head in _HEADS)
        table = table_of("monitor", Column("topic", overflow="fold"), *columns)
        for monitor, where in dict.fromkeys((monitor, where) for monitor, where, _kind in counts):
            add_row(table, monitor, where, *(str(counts[monitor, where, kind]) for kind in KINDS))
        say_table(table)

    def _show_recordings(self) -> None:
        rows = [row for row in self._recordings if any(row.counts)]
        columns = (Column(head, justify="right") for head in ("messages", *_HEADS, "first at", "last at"))
        table = table_of(Column("recording", overflow="fold"), *columns)
        for row in rows[:_MAX_RECORDINGS]:
            times = (f"{time / BILLION:.3f}" for time in (row.first, row.last))
            add_row(table, row.recording, str(row.messages), *map(str, row.counts), *times)
        if rows:
            say_table(table)
        failed = [row for row in self._recordings if row.error]
        for row in failed[:_MAX_RECORDINGS]:
            say(f"{row.recording} failed: {row.error}", "red")
        more = sum(max(len(some) - _MAX_RECORDINGS, 0) for some in (rows, failed))
        if more:
            say(f"{counted(more, 'more recording')} with effects or errors: see --report or --json")


class _Line(NamedTuple):
    recording: str
    messages: int
    counts: tuple[int, ...]
    first: int
    last: int
    error: str

    @classmethod
    def of(cls, recording: str, result: Replayed | Failure) -> Self:
        if isinstance(result, Failure):
            return cls(recording, 0, (), 0, 0, result.text)
        counts = tuple(sum(row.count for row in result.effects if row.kind == kind) for kind in KINDS)
        first = min((row.first for row in result.effects), default=0)
        last = max((row.last for row in result.effects), default=0)
        return cls(recording, result.messages, counts, first, last, "")


def _rows(recording: str, result: Replayed | Failure) -> Iterator[dict[str, object]]:
    if isinstance(result, Failure):
        yield {"kind": "recording", "bag": recording, "error": result.text}
        return
    for found in result.occurrences:
        yield {
            "bag": recording, "monitor": found.monitor, "kind": found.kind, "topic": found.topic, "index": found.index,
            "timer": found.timer, "time": found.time / BILLION, "text": found.text,
        }  # fmt: skip
    for effect in result.effects:
        yield {
            "kind": "count", "bag": recording, "monitor": effect.monitor, "place": effect.place, "effect": effect.kind,
            "count": effect.count, "first": effect.first / BILLION, "last": effect.last / BILLION,
        }  # fmt: skip
    yield {
        "kind": "recording", "bag": recording, "messages": result.messages, "passed": result.passed,
        "changed": result.changed, "dropped": result.dropped, "notes": result.notes,
    }  # fmt: skip


def _margin_row(margin: ClosestMargin, recording: str) -> dict[str, object]:
    return {
        "kind": "margin", "monitor": margin.monitor, "file": margin.file, "line": margin.line, "column": margin.column,
        "holds": margin.holds, "distance": margin.distance, "left": margin.left, "right": margin.right,
        "threshold_at": margin.threshold_at, "bag": recording, "time": margin.time / BILLION, "index": margin.index,
    }  # fmt: skip


def _margin_line(margin: ClosestMargin, recording: str, line: str) -> str:
    place = "" if margin.index is None else f" #{margin.index}"
    where = f"{recording} {margin.time / BILLION:.3f}{place}"
    word = "true" if margin.holds else "false"
    sides = f"{margin.left:.6g} against {margin.right:.6g}"
    position = Position(margin.file, margin.line, margin.column)
    return f"{position}: {line}: {word} by {margin.distance:.6g} at the closest, {sides} ({where})"
