"""Statistics of one field: extremes by window, few values, rates of change, standstills.

Memory is bounded. Merging the statistics of recordings is associative and commutative.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgspec

Statistic = TypeVar("Statistic")
_Key = TypeVar("_Key")

MAX_VALUES = 8


def merged_rows(
    one: Mapping[_Key, Statistic],
    other: Mapping[_Key, Statistic],
    merge: Callable[[Statistic, Statistic], Statistic],
) -> dict[_Key, Statistic]:
    rows = {**one, **other}
    for key in one.keys() & other.keys():
        rows[key] = merge(one[key], other[key])
    return rows


class HighestValues(msgspec.Struct):
    """The largest value in each window of time, by the window's number."""

    of: dict[int, float] = {}

    def add(self, value: float, window: int) -> None:
        if value > self.of.get(window, -math.inf):
            self.of[window] = value

    def merge(self, other: "HighestValues") -> "HighestValues":
        return HighestValues(merged_rows(self.of, other.of, max))

    @property
    def top(self) -> float:
        return max(self.of.values(), default=-math.inf)


class ValueSeries(msgspec.Struct):
    """The distinct values of a field while they are few, and the number of windows with each."""

    windows: dict[Any, int] = {}
    many: bool = False
    last: dict[object, int] = {}

    def add(self, value: object, window: int) -> None:
        if self.many or self.last.get(value) == window:
            return
        self.last[value] = window
        self.windows[value] = self.windows.get(value, 0) + 1
        self._limit()

    def end(self) -> None:
        self.last = {}

    def merge(self, other: "ValueSeries") -> "ValueSeries":
        result = ValueSeries(
            merged_rows(self.windows, other.windows, int.__add__), many=self.many or other.many
        )
        result._limit()
        return result

    @property
    def sorted_values(self) -> list[Any]:
        return sorted(self.windows, key=lambda value: (isinstance(value, bytes), value))

    def _limit(self) -> None:
        if self.many or len(self.windows) > MAX_VALUES:
            self.many = True
            self.windows, self.last = {}, {}

    @property
    def closed(self) -> bool:
        """Whether a new value is unlikely: no value was seen in only one window (Good and Turing's estimate)."""
        return bool(self.windows) and min(self.windows.values()) > 1


class Series(msgspec.Struct):
    """The statistics of a numeric field, or of a numeric array folded into one value.

    `period` is the usual time between two messages in seconds. Closer messages count as one period apart, because
    otherwise network delays would determine their rate.
    """

    period: float
    count: int = 0
    changed: int = 0
    nan: bool = False
    infinite: bool = False
    highs: HighestValues = msgspec.field(default_factory=HighestValues)
    lows: HighestValues = msgspec.field(default_factory=HighestValues)
    values: ValueSeries = msgspec.field(default_factory=ValueSeries)
    rates: HighestValues = msgspec.field(default_factory=HighestValues)
    stays: HighestValues = msgspec.field(default_factory=HighestValues)
    last: float | None = None
    """The last value in a recording, its time, and the time since which it is the same. The end resets all three."""
    time: float = 0.0
    since: float = 0.0

    def end(self) -> None:
        """Forget the last value, because the next recording is independent of this one."""
        self.last, self.time, self.since = None, 0.0, 0.0
        self.values.end()

    def merge(self, other: "Series") -> "Series":
        return Series(
            self.period, self.count + other.count, self.changed + other.changed, self.nan or other.nan,
            self.infinite or other.infinite, self.highs.merge(other.highs), self.lows.merge(other.lows),
            self.values.merge(other.values), self.rates.merge(other.rates), self.stays.merge(other.stays),
        )  # fmt: skip

    def add(self, value: float | int, seconds: float, window: int) -> None:
        """Add a value. Only whole numbers may be an enumeration."""
        self.count += 1
        if not self.values.many and not isinstance(value, float):
            self.values.add(value, window)
        last, self.last = self.last, value
        elapsed = max(seconds - self.time, self.period)
        self.time = seconds
        if last is None or value != last:
            self.since = seconds
        if math.isfinite(value):
            # An integer below -2^63, the negative of a large uint64, cannot be sent by a worker.
            self.highs.add(float(value), window)
            self.lows.add(-float(value), window)
            if last is not None:
                self.stays.add(seconds - self.since, window)
                if value != last:
                    self.changed += 1
                if math.isfinite(last):
                    self.rates.add(abs(value - last) / elapsed, window)
        elif math.isnan(value):
            self.nan = True
        else:
            self.infinite = True

    def add_array(self, low: float, high: float, nan: bool, infinite: bool, window: int) -> None:
        self.count += 1
        self.nan |= nan
        self.infinite |= infinite
        if low <= high:
            self.highs.add(high, window)
            self.lows.add(-low, window)
