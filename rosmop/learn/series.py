"""What is kept of one field over all recordings: extremes by window, few values, how it changes, how long it stays.

Memory is bounded: a number for each window, and as many values as a set may have.
"""

import math
from typing import Any

MOST_VALUES = 8
"""A field with more values is no enumeration."""


class Highs:
    """The highest number of each window."""

    def __init__(self) -> None:
        self.of: dict[int, float] = {}

    def see(self, value: float, window: int) -> None:
        """Take a number that is one."""
        if value > self.of.get(window, -math.inf):
            self.of[window] = value

    @property
    def top(self) -> float:
        """The highest of all; minus infinity without any."""
        return max(self.of.values(), default=-math.inf)


class Values:
    """The different values of a field while they are few, with the number of windows that had each."""

    def __init__(self) -> None:
        self.windows: dict[Any, int] = {}
        self._last: dict[Any, int] = {}
        self.many = False

    def see(self, value: Any, window: int) -> None:
        """Take a value."""
        if self.many or self._last.get(value) == window:
            return
        self._last[value] = window
        self.windows[value] = self.windows.get(value, 0) + 1
        if len(self._last) > MOST_VALUES:
            self.many = True
            self.windows, self._last = {}, {}

    @property
    def closed(self) -> bool:
        """Whether a further value is unlikely: none was seen in one window only (Good and Turing's estimate)."""
        return bool(self.windows) and min(self.windows.values()) > 1


class Series:
    """A field that is a number (or an array of them folded into one): what it was, and how it changed.

    `period` is the usual time between two messages in seconds: two that come closer to each other are taken to be so
    far apart, as a rate would otherwise be that of the network.
    """

    def __init__(self, period: float) -> None:
        self.count = self.changed = 0
        self.nan = self.infinite = False
        self.highs, self.lows = Highs(), Highs()  # of lows the negative
        self.values = Values()
        self.rates, self.stays = Highs(), Highs()
        self._period = period
        self.begin()

    def begin(self) -> None:
        """A recording begins: what comes has nothing to do with what was."""
        self._last: float | None = None
        self._time = self._since = 0.0

    def see(self, value: float, seconds: float, window: int) -> None:
        """Take a value and its time."""
        self.count += 1
        if not self.values.many:
            self.values.see(value, window)
        last, self._last = self._last, value
        elapsed = max(seconds - self._time, self._period)
        self._time = seconds
        if last is None or value != last:
            self._since = seconds
        if math.isfinite(value):
            self.highs.see(value, window)
            self.lows.see(-value, window)
            if last is not None:
                self.stays.see(seconds - self._since, window)
                if value != last:
                    self.changed += 1
                if math.isfinite(last):
                    self.rates.see(abs(value - last) / elapsed, window)
        elif math.isnan(value):
            self.nan = True
        else:
            self.infinite = True

    def see_array(self, low: float, high: float, nan: bool, infinite: bool, window: int) -> None:
        """Take the extremes of an array's finite elements, and whether it has others."""
        self.count += 1
        self.nan |= nan
        self.infinite |= infinite
        if low <= high:
            self.highs.see(high, window)
            self.lows.see(-low, window)
