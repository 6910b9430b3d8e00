"""How close comparisons of numbers came during the replay of a recording. Monitors in force do not measure this."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from rosmop.form.positions import Position
from rosmop.run.engine import MonitorSet


class Margin(NamedTuple):
    """The two sides of a comparison when they were closest, while it was true (`holds`) or while it was false.

    `number` counts the monitor's comparisons in the order of the text. `threshold` is the constant side, 0 or 1 (None:
    neither side is a constant).
    """

    monitor: str
    number: int
    position: Position
    threshold: int | None
    holds: bool
    left: float
    right: float

    @property
    def distance(self) -> float:
        """Return the difference of the sides."""
        return abs(self.left - self.right)

    @property
    def threshold_at(self) -> float | None:
        """Return the constant at which the result would have changed; None if neither side is a constant."""
        return None if self.threshold is None else (self.right, self.left)[self.threshold]


class MarginReader:
    """A reader of the margins of a set that was compiled with `margins`. Create the reader before the set starts."""

    def __init__(self, monitors: MonitorSet) -> None:
        self._monitors = monitors
        self._variables = monitors.interpreter.variables
        for monitor in monitors.monitors:
            for comparison in monitor.code.comparisons:
                for left, right in (comparison.when_true, comparison.when_false):
                    self._variables |= {left: math.inf, right: 0.0}

    def take(self) -> Iterator[Margin]:
        """Yield the closest true and the closest false result of each comparison since the last call."""
        for monitor in self._monitors.monitors:
            for number, comparison in enumerate(monitor.code.comparisons):
                for holds, sides in ((True, comparison.when_true), (False, comparison.when_false)):
                    left, right = (self._variables[name] for name in sides)
                    if not math.isinf(left):
                        self._variables[sides[0]] = math.inf
                        yield Margin(
                            monitor.name,
                            number,
                            comparison.position,
                            comparison.threshold,
                            holds,
                            left,
                            right,
                        )
