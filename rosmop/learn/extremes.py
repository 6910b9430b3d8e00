"""Set a bound beyond the observed values, by extreme value theory on the extremes of independent windows.

Gumbel's distribution, which suits exponential tails, is fitted to the largest value of each window by
L-moments (Hosking 1990). The bound is the level that is passed once in a given number of windows. No shape
parameter is fitted, because some twenty windows are too few: if the quantity has a limit, the margin is wider
than needed, which causes no false alarm.

If a robot sometimes goes far, the upper quarter of windows has a longer tail: the exponential through its
mean excess (Weissman 1978) is the bound if it is higher. An extreme that several windows reach exactly is a
stop, such as a joint's limit, and is then the bound.
"""

import math
from collections.abc import Iterable

FEWEST_WINDOWS = 8

_STOP = 3  # the minimum number of windows that reach the same extreme
_SAME = 1e-9  # relative difference that rounding can cause between equal extremes
_TAIL = 4  # the tail is the highest of this many equal parts of the values
_EULER = 0.5772156649015329


def upper(highs: Iterable[float], windows: float, *, stops: bool = False) -> float | None:
    """Return the level that the maximum of a window exceeds once in `windows` windows, or None with too little data.

    With `stops`, the quantity may have a stop. Calculated quantities have none, because rounded differences
    can be equal by chance.
    """
    values = sorted(highs)
    count = len(values)
    if count < FEWEST_WINDOWS:
        return None
    top = values[-1]
    if stops and top - values[-_STOP] <= _SAME * abs(top):
        return top
    first = sum(values) / count
    second = sum(index * value for index, value in enumerate(values)) / (count * (count - 1))
    scale = (2 * second - first) / math.log(2)
    place = first - _EULER * scale
    level = place - scale * math.log(-math.log1p(-1 / max(windows, 2.0)))
    highest = count // _TAIL
    threshold = values[-highest - 1]
    excess = sum(values[-highest:]) / highest - threshold
    return max(level, threshold + excess * math.log(max(windows * highest / count, 1.0)), top)
