"""Measure how close comparisons of numbers came during a replay. Monitors in force do not measure this."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from rosmop.run.monitor import MonitorInstance
from rosmop.run.outcomes import Margin


def begin_margins(monitors: Sequence[MonitorInstance], variables: dict[str, Any]) -> None:
    for monitor in monitors:
        for comparison in monitor.code.comparisons:
            for left, right in (comparison.when_true, comparison.when_false):
                variables |= {left: math.inf, right: 0.0}


def taken_margins(monitors: Sequence[MonitorInstance], variables: dict[str, Any]) -> Iterator[Margin]:
    for monitor in monitors:
        for number, comparison in enumerate(monitor.code.comparisons):
            for holds, sides in ((True, comparison.when_true), (False, comparison.when_false)):
                left, right = (variables[name] for name in sides)
                if not math.isinf(left):
                    variables[sides[0]] = math.inf
                    place = monitor.name, number, comparison.position, comparison.threshold
                    yield Margin(*place, holds, left, right)
