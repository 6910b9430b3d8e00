"""How far beyond what was seen a bound must be: the theory of extreme values, on the extremes of independent windows.

The largest value of each window is a draw from an extreme value distribution. Gumbel's, that of exponential tails, is
fitted by L-moments (Hosking 1990), and the bound is the level that it passes once in so many windows. A shape is not
fitted: from some twenty windows it cannot be, and where the quantity has an end, the margin is wider than it need be,
which costs no false alarm. Where windows are of different kinds (a robot that stays near, and one that goes far), their
upper quarter has a tail of its own, longer than the fit's: the exponential through its mean excess (Weissman 1978) is
the bound if it is higher. An extreme that several windows reach exactly is a stop (a joint's limit, a clamped
command): it is the bound.
"""

import math
from collections.abc import Iterable

FEWEST_WINDOWS = 8
"""With fewer windows nothing is said about an extreme."""

_STOP = 3  # windows that reach the same extreme
_SAME = 1e-9  # of the value: what calculating makes of the same extreme
_TAIL = 4  # the highest of so many windows
_EULER = 0.5772156649015329


def upper(highs: Iterable[float], windows: float, *, stops: bool = False) -> float | None:
    """The level that the highest value of a window passes once in so many windows; None of too few windows.

    `stops`: the quantity may have one. What is calculated of it has none: differences of rounded numbers are equal by
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
