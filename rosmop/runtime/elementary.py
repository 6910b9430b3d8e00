"""`sin`, `cos`, `atan2` and `hypot` from IEEE operations only, so that every machine gives the same bits.

The algorithms are those of fdlibm (Sun Microsystems, 1993) and, for `hypot`, of musl; the error is below one
unit in the last place. `check/function_library.py` has the same operations in the same order.
"""

import math
from math import copysign, fabs, inf, sqrt

LARGEST = 1048576.0
"""The largest angle of which this holds: the C library computes larger angles."""

_EIGHTH = 7.85398163397448278999e-01
_WHOLE = 1.5 * 2.0**52  # adding and subtracting it rounds to a whole number


def sin(x: float) -> float:
    if fabs(x) <= LARGEST:
        return _turned(x, 0.0)
    return math.sin(x) if math.isfinite(x) else math.nan


def cos(x: float) -> float:
    if fabs(x) <= LARGEST:
        return _turned(x, 1.0)
    return math.cos(x) if math.isfinite(x) else math.nan


def _turned(x: float, quarters: float) -> float:
    # Subtract `turns` right angles in three steps: each has 33 bits of a right angle, and the rest.
    turns = (x * 6.36619772367581382433e-01 + _WHOLE) - _WHOLE
    first = turns * 1.57079632673412561417e00
    a = x - first
    second = turns * 6.07710050630396597660e-11
    b = a - second
    third = turns * 2.02226624871116645580e-21
    c = b - third
    low = turns * 8.47842766036889956997e-32 - ((b - c) - third)
    y = c - low
    z = (c - y) - low
    whole = turns + quarters
    quarter = whole - 4.0 * ((whole * 0.25 + _WHOLE) - _WHOLE)  # from -2 to 2
    square = y * y
    if fabs(quarter) == 1:
        fourth = square * square
        r = square * (
            4.16666666666666019037e-02
            + square * (-1.38888888888741095749e-03 + square * 2.48015872894767294178e-05)
        ) + fourth * fourth * (
            -2.75573143513906633035e-07
            + square * (2.08757232129817482790e-09 + square * -1.13596475577881948265e-11)
        )
        half = 0.5 * square
        one = 1.0 - half
        value = one + (((1.0 - one) - half) + (square * r - y * z))
    else:
        r = (
            8.33333333332248946124e-03
            + square * (-1.98412698298579493134e-04 + square * 2.75573137070700676789e-06)
            + square * (square * square) * (-2.50507602534068634195e-08 + square * 1.58969099521155010221e-10)
        )
        cube = square * y
        value = y - ((square * (0.5 * z - cube * r) - z) - cube * -1.66666666666666324348e-01)
    return -value if quarter < 0 or quarter > 1 else value


def atan2(y: float, x: float) -> float:
    height, width = fabs(y), fabs(x)
    if not (height <= inf and width <= inf):
        return x + y
    if height > width * 2.0**60:
        return copysign(1.57079632679489655800, y)
    angle = (_EIGHTH if height > 0 else 0.0) if height == width else _arctangent(height / width)
    return copysign(math.pi - (angle - 1.2246467991473531772e-16) if copysign(1.0, x) < 0 else angle, y)


def _arctangent(x: float) -> float:
    high, low, v = 0.0, 0.0, x
    if x >= 39 / 16:
        high, low, v = 1.57079632679489655800, 6.12323399573676603587e-17, -1.0 / x
    elif x >= 19 / 16:
        high, low, v = 9.82793723247329054082e-01, 1.39033110312309984516e-17, (x - 1.5) / (1.0 + 1.5 * x)
    elif x >= 11 / 16:
        high, low, v = 7.85398163397448278999e-01, 3.06161699786838301793e-17, (x - 1.0) / (x + 1.0)
    elif x >= 7 / 16:
        high, low, v = 4.63647609000806093515e-01, 2.26987774529616870924e-17, (2.0 * x - 1.0) / (2.0 + x)
    z = v * v
    w = z * z
    odd = 6.66107313738753120669e-02 + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)
    odd = 1.42857142725034663711e-01 + w * (9.09088713343650656196e-02 + w * odd)
    odd = z * (3.33333333333329318027e-01 + w * odd)
    even = -7.69187620504482999495e-02 + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02)
    even = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01 + w * even))
    return high - ((v * (odd + even) - low) - v)


def hypot(x: float, y: float) -> float:
    a, b = fabs(x), fabs(y)
    if inf in {a, b}:
        return inf
    if b > a:
        a, b = b, a
    if b < a * 2.0**-55:
        return a + b
    scale = 1.0
    if a > 2.0**510:
        scale = 2.0**-700
    elif b < 2.0**-450:
        scale = 2.0**700
    a, b = a * scale, b * scale
    p = a * 134217729.0  # splits `a` into parts of 26 bits
    high = (a - p) + p
    low = a - high
    q = b * 134217729.0
    higher = (b - q) + q
    lower = b - higher
    aa, bb = a * a, b * b
    rest = ((higher * higher - bb) + 2.0 * higher * lower + lower * lower) + (
        (high * high - aa) + 2.0 * high * low + low * low
    )
    return sqrt(rest + bb + aa) / scale
