"""What is kept of one topic: how its messages follow each other, and of their fields a series each."""

import statistics
from typing import Any

import numpy as np

from rosmop.learn.field_values import MOST_ELEMENTS, Fields
from rosmop.learn.series import Highs, Series, Values

MOST_SINGLE = 6
"""Arrays that are always of one length and no longer have a series for each element."""

_MOST_GAPS = 5000
_IN_STEP = 60.0  # seconds between a stamp and the reception beyond which they are no clocks of one robot


class Rhythm:
    """The times between the messages of a topic."""

    def __init__(self) -> None:
        self.count = 0
        self.recordings: set[str] = set()
        self.gaps = Highs()
        self._some: list[int] = []  # gaps, for the median
        self._last: int | None = None

    def begin(self) -> None:
        """A recording begins."""
        self._last = None

    def see(self, time: int, window: int, recording: str) -> None:
        """Take the time of a message."""
        self.count += 1
        self.recordings.add(recording)
        if self._last is not None:
            gap = time - self._last
            self.gaps.see(gap / 10**9, window)
            if len(self._some) < _MOST_GAPS:
                self._some.append(gap)
        self._last = time

    @property
    def period(self) -> float:
        """The usual time between two messages in seconds; a nanosecond where it is not known, or is none."""
        return max(statistics.median(self._some) if self._some else 0.0, 1.0) / 10**9

    @property
    def interval(self) -> float:
        """Messages are counted in intervals of so many seconds."""
        return float(max(1, round(5 * self.period)))


class Content:
    """The fields of a topic's messages."""

    def __init__(self, fields: Fields, rhythm: Rhythm) -> None:
        self._fields = fields
        self._period = rhythm.period
        self._interval = rhythm.interval
        self.types = fields.types
        self.numbers: dict[str, Series] = {}
        self.elements: dict[str, list[Series]] = {}
        self.sets: dict[str, Values] = {}
        self.lengths: dict[str, Values] = {}
        self.moves: dict[str, dict[tuple[Any, Any], tuple[int, int]]] = {}
        """Of fields with few values: how often (windows, and the last of them) each was followed by another."""
        self.ages, self.leads, self.counts = Highs(), Highs(), Highs()
        self.backward = False
        """Some message had an earlier stamp than the one before it."""
        self.begin()

    def begin(self) -> None:
        """A recording begins."""
        for series in [
            *self.numbers.values(),
            *(element for row in self.elements.values() for element in row),
        ]:
            series.begin()
        self._before: dict[str, Any] = {}
        self._stamp = -1.0
        self._opened, self._counted = 0.0, 0

    def see(self, data: bytes, time: int, window: int) -> None:
        """Take a message. Raises `MessageError`."""
        seconds = time / 10**9
        for path, value in self._fields.read(data).items():
            kind = self.types[path]
            if kind in {"string", "bool"}:
                self._see_set(path, value, window)
            elif isinstance(value, tuple):
                if path == "header.stamp":
                    self._see_stamp(value[0] + value[1] / 10**9, seconds, window)
            elif kind == "length":
                self._see_length(path, value, window)
            elif kind == "string[]":
                self._see_length(path, len(value), window)
                if len(value) <= MOST_SINGLE:
                    self._see_set(path, tuple(value), window)
            elif isinstance(value, np.ndarray):
                self._see_array(path, value, seconds, window)
            else:
                if path not in self.numbers:
                    self.numbers[path] = Series(self._period)
                self.numbers[path].see(value, seconds, window)
                if not kind.startswith("float") and not self.numbers[path].values.many:
                    self._see_move(path, value, window)
        if seconds - self._opened >= self._interval:
            self._opened, self._counted = seconds, 0
        self._counted += 1
        self.counts.see(self._counted, window)

    def _see_set(self, path: str, value: Any, window: int) -> None:
        if path not in self.sets:
            self.sets[path] = Values()
        found = self.sets[path]
        found.see(value, window)
        if not found.many:
            self._see_move(path, value, window)

    def _see_move(self, path: str, value: Any, window: int) -> None:
        before = self._before.get(path)
        if before is not None and before != value:
            moves = self.moves.setdefault(path, {})
            windows, last = moves.get((before, value), (0, -1))
            moves[before, value] = (windows + (last != window), window)
        self._before[path] = value

    def _see_stamp(self, stamp: float, seconds: float, window: int) -> None:
        age = seconds - stamp
        if abs(age) <= _IN_STEP:
            self.ages.see(age, window)
            self.leads.see(-age, window)
        self.backward |= stamp < self._stamp
        self._stamp = stamp

    def _see_length(self, path: str, length: int, window: int) -> None:
        if path not in self.lengths:
            self.lengths[path] = Values()
        self.lengths[path].see(length, window)

    def _see_array(self, path: str, array: "np.ndarray[Any, Any]", seconds: float, window: int) -> None:
        self._see_length(path, len(array), window)
        if len(array) > MOST_ELEMENTS:
            return
        if len(array) <= MOST_SINGLE and len(self.lengths[path].windows) == 1:
            row = self.elements.setdefault(path, [Series(self._period) for _ in array])
            for series, value in zip(row, array.tolist(), strict=True):
                series.see(value, seconds, window)
        else:
            self.elements.pop(path, None)
        if path not in self.numbers:
            self.numbers[path] = Series(self._period)
        finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
        nan = bool(np.isnan(array).any()) if len(finite) < len(array) else False
        infinite = bool(np.isinf(array).any()) if len(finite) < len(array) else False
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (1.0, 0.0)
        self.numbers[path].see_array(low, high, nan, infinite, window)
