"""Calculate as C++ on a 64-bit machine: two's complement that wraps, IEEE floating point, 32-bit floats."""

import ctypes
import math
import struct
from collections.abc import Callable
from fractions import Fraction

from rosmop.runtime import elementary
from rosmop.runtime.action_context import FaultError

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
    "sin": (1, elementary.sin),
    "cos": (1, elementary.cos),
    "tan": (1, _total(math.tan)),
    "asin": (1, _total(math.asin)),
    "acos": (1, _total(math.acos)),
    "atan": (1, math.atan),
    "atan2": (2, elementary.atan2),
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
    "hypot": (2, elementary.hypot),
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
