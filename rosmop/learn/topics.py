"""Statistics of one topic: the intervals of its messages, and a series for each field."""

import math
import statistics
from typing import Any

from rosmop.learn.field_values import Fields
from rosmop.learn.series import HighestValues, Series, ValueSeries

MOST_SINGLE = 6
"""Arrays that always have the same length, up to this maximum, have a series for each element."""

_MOST_GAPS = 5000
_IN_STEP = 60.0  # seconds from a stamp to its reception; longer times mean clocks of different robots


class TopicRhythm:
    """The times between the messages of a topic."""

    def __init__(self) -> None:
        self.count = 0
        self.recordings: set[str] = set()
        self.gaps = HighestValues()
        self._some: list[int] = []  # gaps, for the median
        self._last: int | None = None

    def begin(self) -> None:
        """Enter a new recording."""
        self._last = None

    def add(self, time: int, window: int, recording: str) -> None:
        """Add the time of a message."""
        self.count += 1
        self.recordings.add(recording)
        if self._last is not None:
            gap = time - self._last
            self.gaps.add(gap / 10**9, window)
            if len(self._some) < _MOST_GAPS:
                self._some.append(gap)
        self._last = time

    @property
    def period(self) -> float:
        """Return the usual interval in seconds; a nanosecond if the interval is unknown."""
        return max(statistics.median(self._some) if self._some else 0.0, 1.0) / 10**9

    @property
    def interval(self) -> float:
        """Return the length in seconds of the intervals in which messages are counted."""
        return float(max(1, round(5 * self.period)))


class TopicContent:
    """The fields of a topic's messages."""

    def __init__(self, fields: Fields, rhythm: TopicRhythm) -> None:
        self._fields = fields
        self._period = rhythm.period
        self._interval = rhythm.interval
        self.types = fields.types
        self.numbers: dict[str, Series] = {}
        self.elements: dict[str, list[Series]] = {}
        self.sets: dict[str, ValueSeries] = {}
        self.lengths: dict[str, ValueSeries] = {}
        self.moves: dict[str, dict[tuple[Any, Any], tuple[int, int]]] = {}
        """For fields with few values: how often a value was followed by another value (number of windows, the last
        window).
        """
        self.ages, self.leads, self.counts = HighestValues(), HighestValues(), HighestValues()
        self.backward = False
        """Whether some message had an earlier stamp than the previous message."""
        self.begin()

    def begin(self) -> None:
        """Enter a new recording."""
        for series in [
            *self.numbers.values(),
            *(element for row in self.elements.values() for element in row),
        ]:
            series.begin()
        self._before: dict[str, Any] = {}
        self._stamp = -1.0
        self._opened, self._counted = 0.0, 0

    def add(self, data: bytes, time: int, window: int) -> None:
        """Add a message. Raises `MessageError`."""
        seconds = time / 10**9
        for path, value in self._fields.read(data).items():
            kind = self.types[path]
            if kind in {"string", "bool"}:
                self._add_set(path, value, window)
            elif kind in {"time", "duration"}:
                if path == "header.stamp":
                    self._add_stamp(value[0] + value[1] / 10**9, seconds, window)
            elif kind == "length" or (kind.endswith("[]") and isinstance(value, int)):
                self._add_length(path, value, window)
            elif kind == "string[]":
                self._add_length(path, len(value), window)
                if len(value) <= MOST_SINGLE:
                    self._add_set(path, tuple(value), window)
            elif isinstance(value, tuple):
                self._add_array(path, value, seconds, window)
            else:
                if path not in self.numbers:
                    self.numbers[path] = Series(self._period)
                self.numbers[path].add(value, seconds, window)
                if not kind.startswith("float") and not self.numbers[path].values.many:
                    self._add_move(path, value, window)
        if seconds - self._opened >= self._interval:
            self._opened, self._counted = seconds, 0
        self._counted += 1
        self.counts.add(self._counted, window)

    def _add_set(self, path: str, value: Any, window: int) -> None:
        if path not in self.sets:
            self.sets[path] = ValueSeries()
        found = self.sets[path]
        found.add(value, window)
        if not found.many:
            self._add_move(path, value, window)

    def _add_move(self, path: str, value: Any, window: int) -> None:
        before = self._before.get(path)
        if before is not None and before != value:
            moves = self.moves.setdefault(path, {})
            windows, last = moves.get((before, value), (0, -1))
            moves[before, value] = (windows + (last != window), window)
        self._before[path] = value

    def _add_stamp(self, stamp: float, seconds: float, window: int) -> None:
        age = seconds - stamp
        if abs(age) <= _IN_STEP:
            self.ages.add(age, window)
            self.leads.add(-age, window)
        self.backward |= stamp < self._stamp
        self._stamp = stamp

    def _add_length(self, path: str, length: int, window: int) -> None:
        if path not in self.lengths:
            self.lengths[path] = ValueSeries()
        self.lengths[path].add(length, window)

    def _add_array(self, path: str, array: tuple[float, ...], seconds: float, window: int) -> None:
        self._add_length(path, len(array), window)
        if len(array) <= MOST_SINGLE and len(self.lengths[path].windows) == 1:
            row = self.elements.setdefault(path, [Series(self._period) for _ in array])
            for series, value in zip(row, array, strict=True):
                series.add(value, seconds, window)
        else:
            self.elements.pop(path, None)
        if path not in self.numbers:
            self.numbers[path] = Series(self._period)
        finite = array if math.isfinite(sum(array)) else [value for value in array if math.isfinite(value)]
        nan = len(finite) < len(array) and any(map(math.isnan, array))
        infinite = len(finite) < len(array) and any(map(math.isinf, array))
        low, high = (float(min(finite)), float(max(finite))) if finite else (1.0, 0.0)
        self.numbers[path].add_array(low, high, nan, infinite, window)
