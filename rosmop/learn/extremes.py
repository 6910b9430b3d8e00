"""Set a bound beyond the observed values, by extreme value theory on the extremes of independent windows.

The largest value of each window is a draw from an extreme value distribution. Gumbel's, that of exponential tails, is
fitted by L-moments (Hosking 1990), and the bound is the level that it passes once in a given number of windows. A
shape is not fitted, because some twenty windows are too few for it. If the quantity has a limit, the margin is
therefore wider than needed, which causes no false alarm. Where windows are of different kinds (a robot that stays
near, and one that goes far), their upper quarter has a tail of its own, longer than the fit's: the exponential through
its mean excess (Weissman 1978) is the bound if it is higher. An extreme that several windows reach exactly is a stop
(a joint's limit, a clamped command): it is the bound.
"""

import math
from collections.abc import Iterable

FEWEST_WINDOWS = 8
"""The minimum number of windows for a statement about an extreme."""

_STOP = 3  # windows that reach the same extreme
_SAME = 1e-9  # relative difference by which calculation changes the same extreme
_TAIL = 4  # the number of highest values in the tail
_EULER = 0.5772156649015329


def upper(highs: Iterable[float], windows: float, *, stops: bool = False) -> float | None:
    """Return the level that the maximum of a window exceeds once in `windows` windows; None with too little data.

    `stops`: the quantity may have a stop. Calculated quantities have none: differences of rounded numbers are equal by
    chance.
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
