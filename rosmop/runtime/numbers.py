"""Calculate as C++ on a 64-bit machine: two's complement that wraps, IEEE floating point, 32-bit floats."""

import ctypes
import math
import struct
from collections.abc import Callable
from fractions import Fraction
from math import copysign, fabs, inf, sqrt

from rosmop.runtime.action_context import FaultError

# `sin`, `cos`, `atan2` and `hypot` from IEEE operations only, so that every machine gives the same bits.
#
# The algorithms are those of fdlibm (Sun Microsystems, 1993) and, for `hypot`, of musl; the error is below one
# unit in the last place. `check/function_library.py` has the same operations in the same order.

LARGEST = 1048576.0
"""The largest angle of which this holds: the C library computes larger angles."""

_EIGHTH = 7.85398163397448278999e-01
_WHOLE = 1.5 * 2.0**52  # adding and subtracting it rounds to a whole number


def sin(x: float) -> float:
    if fabs(x) <= LARGEST:
        return _turn(x, 0.0)
    return math.sin(x) if math.isfinite(x) else math.nan


def cos(x: float) -> float:
    if fabs(x) <= LARGEST:
        return _turn(x, 1.0)
    return math.cos(x) if math.isfinite(x) else math.nan


def _turn(x: float, quarters: float) -> float:
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


_F32 = struct.Struct("<f")
_EXACT = 1 << 53
_F32_LIMIT = 3.4028235677973366e38  # from this number on, the nearest float is infinite


def f32(value: float) -> float:
    if -_F32_LIMIT < value < _F32_LIMIT:
        result: float = _F32.unpack(_F32.pack(value))[0]
        return result
    return math.copysign(math.inf, value) if value == value else float(value)  # noqa: PLR0124  not NaN


def f32_of_integer(value: int) -> float:
    """Round only once: a double cannot hold an integer beyond 2**53, so its low bits are first merged into one."""
    if -_EXACT <= value <= _EXACT:
        return f32(value)
    size = abs(value)
    low = size.bit_length() - 40
    gathered = (size >> low | (size & (1 << low) - 1 != 0)) << low
    return f32(gathered if value > 0 else -gathered)


def truncate(value: float, least: int, most: int) -> int:
    """Truncate toward zero, within the limits; NaN becomes 0."""
    if value != value:  # noqa: PLR0124  NaN
        return 0
    if value <= least:
        return least
    return most if value >= most else int(value)


def wrap(value: int, bits: int, signed: bool) -> int:
    value &= (1 << bits) - 1
    return value - (1 << bits) if signed and value >> (bits - 1) else value


def divide(left: int, right: int, site: int) -> int:
    if right == 0:
        raise FaultError(site, "division by zero")
    result = abs(left) // abs(right)
    return -result if (left < 0) != (right < 0) else result


def remainder(left: int, right: int, site: int) -> int:
    """Return the remainder, which has the sign of `left`."""
    if right == 0:
        raise FaultError(site, "division by zero")
    result = abs(left) % abs(right)
    return -result if left < 0 else result


def ratio(left: float, right: float) -> float:
    """Divide as IEEE: division by zero gives infinity or NaN."""
    try:
        return left / right
    except ZeroDivisionError:
        if left == 0 or left != left:  # noqa: PLR0124  NaN
            return math.nan
        return math.copysign(math.inf, left) * math.copysign(1.0, right)


def _total(function: Callable[..., float]) -> Callable[..., float]:
    def answer(*arguments: float) -> float:
        try:
            return float(function(*arguments))
        except ValueError:
            return math.nan
        except OverflowError:
            return math.inf

    return answer


def _log(function: Callable[[float], float]) -> Callable[[float], float]:
    def answer(value: float) -> float:
        if value > 0:
            return function(value)
        return -math.inf if value == 0 else math.nan

    return answer


def power(base: float, exponent: float) -> float:
    try:
        return math.pow(base, exponent)
    except ValueError:
        if base != 0:
            return math.nan
        odd = exponent == math.floor(exponent) and exponent % 2 == 1
        return math.copysign(math.inf, base) if odd else math.inf
    except OverflowError:
        odd = exponent == math.floor(exponent) and exponent % 2 == 1
        return -math.inf if base < 0 and odd else math.inf


def round_half_away(value: float) -> float:
    if not math.isfinite(value):
        return value
    whole = math.floor(abs(value))
    return math.copysign(whole + (abs(value) - whole >= 0.5), value)


def round_half_even(value: float) -> float:
    return math.copysign(float(round(value)), value) if math.isfinite(value) else value


def floor(value: float) -> float:
    return math.copysign(float(math.floor(value)), value) if math.isfinite(value) else value


def ceil(value: float) -> float:
    return math.copysign(float(math.ceil(value)), value) if math.isfinite(value) else value


def trunc(value: float) -> float:
    return math.copysign(float(math.trunc(value)), value) if math.isfinite(value) else value


def fma(left: float, right: float, added: float) -> float:
    """C's `fma`, which rounds only once."""
    if not (math.isfinite(left) and math.isfinite(right)):
        return left * right + added
    if not math.isfinite(added):
        return added
    exact = Fraction(left) * Fraction(right) + Fraction(added)
    if not exact:
        return left * right + added
    try:
        return float(exact)
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


def signbit(value: float) -> bool:
    return math.copysign(1.0, value) < 0


def _inverse_hyperbolic_tangent(value: float) -> float:
    return math.copysign(math.inf, value) if abs(value) == 1 else _total(math.atanh)(value)


def fmin(left: float, right: float) -> float:
    """C's `fmin`: a number is preferred to NaN."""
    return right if left != left or right < left else left  # noqa: PLR0124  NaN


def fmax(left: float, right: float) -> float:
    """C's `fmax`: a number is preferred to NaN."""
    return right if left != left or right > left else left  # noqa: PLR0124  NaN


def positive_difference(left: float, right: float) -> float:
    if math.isnan(left) or math.isnan(right):
        return math.nan
    return left - right if left > right else 0.0


def _hyperbolic_sine(value: float) -> float:
    try:
        return math.sinh(value)
    except OverflowError:
        return math.copysign(math.inf, value)


MATH: dict[str, tuple[int, Callable[..., float]]] = {
    "sqrt": (1, _total(math.sqrt)),
    "cbrt": (1, math.cbrt),
    "sin": (1, sin),
    "cos": (1, cos),
    "tan": (1, _total(math.tan)),
    "asin": (1, _total(math.asin)),
    "acos": (1, _total(math.acos)),
    "atan": (1, math.atan),
    "atan2": (2, atan2),
    "sinh": (1, _hyperbolic_sine),
    "cosh": (1, _total(math.cosh)),
    "tanh": (1, math.tanh),
    "asinh": (1, math.asinh),
    "acosh": (1, _total(math.acosh)),
    "atanh": (1, _inverse_hyperbolic_tangent),
    "fma": (3, fma),
    "exp": (1, _total(math.exp)),
    "exp2": (1, lambda value: power(2.0, value)),
    "expm1": (1, _total(math.expm1)),
    "log": (1, _log(math.log)),
    "log2": (1, _log(math.log2)),
    "log10": (1, _log(math.log10)),
    "log1p": (1, lambda value: _log(math.log)(1.0 + value) if value <= -1 else math.log1p(value)),
    "pow": (2, power),
    "fmod": (2, _total(math.fmod)),
    "remainder": (2, _total(math.remainder)),
    "hypot": (2, hypot),
    "floor": (1, floor),
    "ceil": (1, ceil),
    "round": (1, round_half_away),
    "rint": (1, round_half_even),
    "nearbyint": (1, round_half_even),
    "trunc": (1, trunc),
    "fabs": (1, math.fabs),
    "fmin": (2, fmin),
    "fmax": (2, fmax),
    "fdim": (2, positive_difference),
    "copysign": (2, math.copysign),
    "erf": (1, math.erf),
    "erfc": (1, math.erfc),
}


def _of_floats(name: str, count: int) -> Callable[..., float]:
    """Return a function of the C library, with the bits that a compiled C++ monitor would get."""
    function = ctypes.CDLL("libm.so.6")[f"{name}f"]
    function.argtypes, function.restype = [ctypes.c_float] * count, ctypes.c_float

    def call(*values: float) -> float:  # this wrapper hides the other attributes of the library's object
        result: float = function(*values)
        return result

    return call


FLOAT_MATH: dict[str, Callable[..., float]] = {
    name: _of_floats(name, count) for name, (count, _) in MATH.items()
}
"""Functions on 32-bit floats, whose results can differ from rounded doubles, as for `sinf(380738.94)`."""
