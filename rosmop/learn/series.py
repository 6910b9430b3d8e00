"""Statistics of one field over all recordings: extremes by window, few values, rates of change, standstills.

Memory is bounded: one number for each window, and a limited set of values.
"""

import math
from typing import Any

MOST_VALUES = 8
"""A field with more distinct values is not an enumeration."""


class HighestValues:
    """The highest number of each window."""

    def __init__(self) -> None:
        self.of: dict[int, float] = {}

    def add(self, value: float, window: int) -> None:
        """Add a number that is not NaN."""
        if value > self.of.get(window, -math.inf):
            self.of[window] = value

    @property
    def top(self) -> float:
        """Return the highest number of all windows; minus infinity if there is none."""
        return max(self.of.values(), default=-math.inf)


class ValueSeries:
    """The distinct values of a field while they are few, and the number of windows with each."""

    def __init__(self) -> None:
        self.windows: dict[Any, int] = {}
        self._last: dict[Any, int] = {}
        self.many = False

    def add(self, value: Any, window: int) -> None:
        """Add a value."""
        if self.many or self._last.get(value) == window:
            return
        self._last[value] = window
        self.windows[value] = self.windows.get(value, 0) + 1
        if len(self._last) > MOST_VALUES:
            self.many = True
            self.windows, self._last = {}, {}

    @property
    def closed(self) -> bool:
        """Whether a further value is unlikely, because no value was seen in only one window (Good and Turing's
        estimate).
        """
        return bool(self.windows) and min(self.windows.values()) > 1


class Series:
    """A numeric field, or a numeric array folded into one value: its values, and how they changed.

    `period` is the usual time between two messages in seconds. Closer messages count as one period apart, because
    otherwise network delays would determine their rate.
    """

    def __init__(self, period: float) -> None:
        self.count = self.changed = 0
        self.nan = self.infinite = False
        self.highs, self.lows = HighestValues(), HighestValues()  # `lows` has the negated values
        self.values = ValueSeries()
        self.rates, self.stays = HighestValues(), HighestValues()
        self._period = period
        self.begin()

    def begin(self) -> None:
        """Begin a recording, whose values are independent of earlier values."""
        self._last: float | None = None
        self._time = self._since = 0.0

    def add(self, value: float, seconds: float, window: int) -> None:
        """Add a value and its time."""
        self.count += 1
        if not self.values.many:
            self.values.add(value, window)
        last, self._last = self._last, value
        elapsed = max(seconds - self._time, self._period)
        self._time = seconds
        if last is None or value != last:
            self._since = seconds
        if math.isfinite(value):
            self.highs.add(value, window)
            self.lows.add(-value, window)
            if last is not None:
                self.stays.add(seconds - self._since, window)
                if value != last:
                    self.changed += 1
                if math.isfinite(last):
                    self.rates.add(abs(value - last) / elapsed, window)
        elif math.isnan(value):
            self.nan = True
        else:
            self.infinite = True

    def add_array(self, low: float, high: float, nan: bool, infinite: bool, window: int) -> None:
        """Add the extremes of an array's finite elements, and whether it has NaNs or infinite elements."""
        self.count += 1
        self.nan |= nan
        self.infinite |= infinite
        if low <= high:
            self.highs.add(high, window)
            self.lows.add(-low, window)
