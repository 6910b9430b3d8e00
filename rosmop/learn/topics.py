"""Statistics of one topic: the intervals of its messages, and a series for each field."""

import math
import statistics
from typing import Any

import msgspec

from rosmop.learn.field_values import Fields
from rosmop.learn.series import HighestValues, Series, ValueSeries, merged_rows

MAX_SINGLE = 6

MAX_GAPS = 5000

_IN_STEP = 60.0  # seconds from a stamp to its reception; longer times mean clocks of different robots


class TopicRhythm(msgspec.Struct):
    """The times between the messages of a topic."""

    count: int = 0
    recordings: set[int] = set()
    gaps: HighestValues = msgspec.field(default_factory=HighestValues)
    some: dict[int, list[int]] = {}
    last: int | None = None

    def begin(self, recording: int, first_window: int) -> None:
        self.recordings.add(recording)
        self.some[first_window] = []

    def add(self, time: int, window: int, most: int) -> None:
        self.count += 1
        if self.last is not None:
            gap = time - self.last
            self.gaps.add(gap / 10**9, window)
            (some,) = self.some.values()
            if len(some) < most:
                some.append(gap)
        self.last = time

    def end(self) -> None:
        self.last = None

    def merge(self, other: "TopicRhythm") -> "TopicRhythm":
        return TopicRhythm(
            self.count + other.count, self.recordings | other.recordings, self.gaps.merge(other.gaps),
            {**self.some, **other.some},
        )  # fmt: skip

    @property
    def period(self) -> float:
        gaps = [gap for some in self.some.values() for gap in some]
        return max(statistics.median(gaps) if gaps else 0.0, 1.0) / 10**9

    @property
    def interval(self) -> float:
        return float(max(1, round(5 * self.period)))


Moves = dict[tuple[object, object], int]
"""The number of windows with each move from a value to another."""


class TopicContent(msgspec.Struct):
    """The fields of a topic's messages."""

    numbers: dict[str, Series] = {}
    elements: dict[str, list[Series]] = {}
    sets: dict[str, ValueSeries] = {}
    lengths: dict[str, ValueSeries] = {}
    moves: dict[str, Moves] = {}
    ages: HighestValues = msgspec.field(default_factory=HighestValues)
    leads: HighestValues = msgspec.field(default_factory=HighestValues)
    counts: HighestValues = msgspec.field(default_factory=HighestValues)
    backward: bool = False

    def merge(self, other: "TopicContent") -> "TopicContent":
        result = TopicContent(
            merged_rows(self.numbers, other.numbers, Series.merge),
            merged_rows(self.elements, other.elements, _merge_elements),
            merged_rows(self.sets, other.sets, ValueSeries.merge),
            merged_rows(self.lengths, other.lengths, ValueSeries.merge),
            merged_rows(self.moves, other.moves, _merge_moves),
            self.ages.merge(other.ages), self.leads.merge(other.leads), self.counts.merge(other.counts),
            self.backward or other.backward,
        )  # fmt: skip
        result.limit()
        return result

    def limit(self) -> None:
        for path in [path for path in self.elements if len(self.lengths[path].windows) != 1]:
            del self.elements[path]
        for path in [path for path in self.moves if self._values(path).many]:
            del self.moves[path]

    def _values(self, path: str) -> ValueSeries:
        return self.sets[path] if path in self.sets else self.numbers[path].values


def _merge_elements(one: list[Series], other: list[Series]) -> list[Series]:
    # Arrays of different lengths are left out afterwards, by `limit`.
    return [a.merge(b) for a, b in zip(one, other, strict=False)]


def _merge_moves(one: Moves, other: Moves) -> Moves:
    return merged_rows(one, other, int.__add__)


class TopicContentReader:
    """Reads the messages of a topic in one recording; the topic's rhythm has this `period` and `interval`."""

    def __init__(self, fields: Fields, period: float, interval: float) -> None:
        self.content = TopicContent()
        self._fields = fields
        self._types = fields.types
        self._period = period
        self._interval = interval
        self._before: dict[str, object] = {}
        self._moved: dict[tuple[str, object, object], int] = {}  # the last window of each move
        self._stamp = -1.0
        self._opened, self._counted = 0.0, 0

    def finish(self) -> TopicContent:
        content = self.content
        for series in [
            *content.numbers.values(),
            *(each for row in content.elements.values() for each in row),
        ]:
            series.end()
        for values in [*content.sets.values(), *content.lengths.values()]:
            values.end()
        content.limit()
        return content

    def add(self, data: bytes, time: int, window: int) -> None:
        seconds = time / 10**9
        values: dict[str, Any] = self._fields.read(data)  # `_types` has the types
        for path, value in values.items():
            kind = self._types[path]
            if kind in {"string", "bool"}:
                self._add_set(path, value, window)
            elif kind in {"time", "duration"}:
                if path == "header.stamp":
                    self._add_stamp(value[0] + value[1] / 10**9, seconds, window)
            elif kind == "length" or (kind.endswith("[]") and isinstance(value, int)):
                self._add_length(path, value, window)
            elif kind == "string[]":
                self._add_length(path, len(value), window)
                if len(value) <= MAX_SINGLE:
                    self._add_set(path, tuple(value), window)
            elif isinstance(value, tuple):
                self._add_array(path, value, seconds, window)
            else:
                if path not in self.content.numbers:
                    self.content.numbers[path] = Series(self._period)
                self.content.numbers[path].add(value, seconds, window)
                if not kind.startswith("float") and not self.content.numbers[path].values.many:
                    self._add_move(path, value, window)
        if seconds - self._opened >= self._interval:
            self._opened, self._counted = seconds, 0
        self._counted += 1
        self.content.counts.add(self._counted, window)

    def _add_set(self, path: str, value: object, window: int) -> None:
        if path not in self.content.sets:
            self.content.sets[path] = ValueSeries()
        found = self.content.sets[path]
        found.add(value, window)
        if not found.many:
            self._add_move(path, value, window)

    def _add_move(self, path: str, value: object, window: int) -> None:
        before = self._before.get(path)
        if before is not None and before != value:
            moves = self.content.moves.setdefault(path, {})
            if self._moved.get((path, before, value)) != window:
                self._moved[path, before, value] = window
                moves[before, value] = moves.get((before, value), 0) + 1
        self._before[path] = value

    def _add_stamp(self, stamp: float, seconds: float, window: int) -> None:
        age = seconds - stamp
        if abs(age) <= _IN_STEP:
            self.content.ages.add(age, window)
            self.content.leads.add(-age, window)
        self.content.backward |= stamp < self._stamp
        self._stamp = stamp

    def _add_length(self, path: str, length: int, window: int) -> None:
        if path not in self.content.lengths:
            self.content.lengths[path] = ValueSeries()
        self.content.lengths[path].add(length, window)

    def _add_array(self, path: str, array: tuple[float, ...], seconds: float, window: int) -> None:
        self._add_length(path, len(array), window)
        if len(array) <= MAX_SINGLE and len(self.content.lengths[path].windows) == 1:
            row = self.content.elements.setdefault(path, [Series(self._period) for _ in array])
            for series, value in zip(row, array, strict=True):
                series.add(value, seconds, window)
        else:
            self.content.elements.pop(path, None)
        if path not in self.content.numbers:
            self.content.numbers[path] = Series(self._period)
        finite = array if math.isfinite(sum(array)) else [value for value in array if math.isfinite(value)]
        nan = len(finite) < len(array) and any(map(math.isnan, array))
        infinite = len(finite) < len(array) and any(map(math.isinf, array))
        low, high = (float(min(finite)), float(max(finite))) if finite else (1.0, 0.0)
        self.content.numbers[path].add_array(low, high, nan, infinite, window)
