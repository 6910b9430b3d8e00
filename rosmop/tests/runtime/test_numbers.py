import ctypes
import itertools
import math
import struct
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosmop.runtime import numbers

LIBRARY = ctypes.CDLL(None)


@given(st.floats())
def test_a_float_is_what_c_makes_of_a_double(value: float) -> None:
    expected = ctypes.c_float(value).value
    result = numbers.f32(value)
    assert struct.pack("d", result) == struct.pack("d", expected) or (
        math.isnan(result) and math.isnan(expected)
    )


@given(st.integers(-(2**63), 2**64 - 1))
def test_an_integer_becomes_the_nearest_float(value: int) -> None:
    result = numbers.f32_of_integer(value)
    assert numbers.f32(result) == result
    step = max(2.0 ** (abs(value).bit_length() - 24), 1.0)
    distance = abs(Fraction(result) - value)
    assert distance <= Fraction(step) / 2
    if distance == Fraction(step) / 2:
        assert result / step % 2 == 0


@given(st.integers(), st.sampled_from([8, 16, 32, 64]), st.booleans())
def test_wrapping_keeps_the_low_bits(value: int, bits: int, signed: bool) -> None:
    result = numbers.wrap(value, bits, signed)
    assert (value - result) % (1 << bits) == 0
    assert -(1 << bits - 1) * signed <= result < 1 << (bits - signed)


@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1).filter(bool))
def test_division_is_toward_zero(left: int, right: int) -> None:
    quotient, rest = numbers.divide(left, right, 0), numbers.remainder(left, right, 0)
    assert quotient * right + rest == left
    assert abs(rest) < abs(right)
    assert rest == 0 or (rest < 0) == (left < 0)


@pytest.mark.parametrize("name", sorted(numbers.MATH))
def test_a_function_of_math_is_that_of_the_c_library(name: str) -> None:
    count, function = numbers.MATH[name]
    theirs = getattr(LIBRARY, name)
    theirs.restype, theirs.argtypes = ctypes.c_double, [ctypes.c_double] * count
    values = (
        0.0,
        -0.0,
        0.5,
        -0.5,
        1.0,
        -1.0,
        1.5,
        2.5,
        -2.5,
        3.0,
        -3.0,
        100.25,
        1e300,
        -1e300,
        math.inf,
        -math.inf,
        math.nan,
    )
    for left in values:
        for arguments in [(left, *others) for others in itertools.product(values, repeat=count - 1)]:
            mine, expected = function(*arguments), theirs(*arguments)
            same = math.isclose(mine, expected, rel_tol=1e-13, abs_tol=1e-300) or (
                math.isnan(mine) and math.isnan(expected)
            )
            assert same, (name, arguments, mine, expected)


@given(st.floats(allow_nan=False))
def test_truncation_saturates(value: float) -> None:
    result = numbers.truncate(value, -100, 100)
    assert result == max(
        -100, min(100, math.trunc(value) if math.isfinite(value) else math.copysign(1e9, value))
    )
    assert numbers.truncate(math.nan, -100, 100) == 0
