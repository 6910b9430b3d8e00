"""Translate numbers, times and truth values of the intermediate form to terms of z3: conversions and operators.

For 32-bit floats, the interpreter rounds the double result of `+ - * /`. That equals the result on floats, because a
double has more than twice as many digits. The sum of two times fits in 64 bits.
"""

from collections.abc import Callable, Mapping, Sequence
from math import inf
from types import MappingProxyType

import z3

from rosmop.prove.terms import (
    DOUBLE,
    NEAREST,
    SINGLE,
    Term,
    as_bits,
    floating,
    integer,
    opposite,
)
from rosmop.runtime import times
from rosmop.types import value_types
from rosmop.types.value_types import Type

LONG = value_types.IntegerType(64, True, "long")


class UnknownError(Exception):
    """The form has a node that cannot be translated."""


def is_signed(kind: Type) -> bool:
    return not isinstance(kind, value_types.IntegerType) or kind.signed


def width(kind: Type) -> int:
    return 32 if isinstance(kind, value_types.IntegerType) and kind.bits <= 32 else 64


def wrap(value: Term, kind: value_types.IntegerType) -> Term:
    if kind.bits >= 32:
        return value
    return (z3.SignExt if kind.signed else z3.ZeroExt)(32 - kind.bits, z3.Extract(kind.bits - 1, 0, value))


def word(value: Term, kind: Type) -> Term:
    if isinstance(kind, value_types.FloatingType):
        return z3.fpToIEEEBV(value if kind.bits == 64 else z3.fpFPToFP(NEAREST, value, DOUBLE))
    bits = as_bits(value) if z3.is_bool(value) else value
    return bits if bits.size() == 64 else (z3.SignExt if is_signed(kind) else z3.ZeroExt)(32, bits)


def convert_term(value: Term, source: Type, target: Type) -> Term:
    if isinstance(target, value_types.BoolType):
        if isinstance(source, value_types.FloatingType):
            return opposite(z3.fpIsZero(value))
        return value if isinstance(source, value_types.BoolType) else value != 0
    if isinstance(source, value_types.BoolType):
        source, value = value_types.INT, as_bits(value)
    if isinstance(target, value_types.FloatingType):
        sort = DOUBLE if target.bits == 64 else SINGLE
        if isinstance(source, value_types.FloatingType):
            return value if source.bits == target.bits else z3.fpFPToFP(NEAREST, value, sort)
        return (z3.fpSignedToFP if is_signed(source) else z3.fpUnsignedToFP)(NEAREST, value, sort)
    if not isinstance(target, value_types.IntegerType):
        raise UnknownError(f"a conversion to {target}")
    if isinstance(source, value_types.FloatingType):
        return truncate(convert_term(value, source, value_types.FloatingType(64)), target)
    if width(target) > value.size():
        value = (z3.SignExt if is_signed(source) else z3.ZeroExt)(32, value)
    return wrap(value if width(target) == value.size() else z3.Extract(31, 0, value), target)


def truncate(value: Term, target: value_types.IntegerType) -> Term:
    whole = target if target.bits >= 32 else value_types.INT
    bits = whole.bits
    least, most = floating(whole.least, 64), floating(whole.most, 64)
    cut = (z3.fpToSBV if whole.signed else z3.fpToUBV)(z3.RTZ(), value, z3.BitVecSort(bits))
    high = z3.If(z3.fpGEQ(value, most), integer(whole.most, bits), cut)
    low = z3.If(z3.fpLEQ(value, least), integer(whole.least, bits), high)
    result = z3.If(z3.fpIsNaN(value), integer(0, bits), low)
    if whole is not target:
        result = z3.If(result < target.least, integer(target.least, 32), result)
        result = z3.If(result > target.most, integer(target.most, 32), result)
    return result


def decode(bits: Term, kind: Type) -> Term:
    if isinstance(kind, value_types.TimeType | value_types.DurationType):
        extend = z3.ZeroExt if kind == value_types.TIME else z3.SignExt
        seconds, rest = (extend(32, z3.Extract(more + 31, more, bits)) for more in (0, 32))
        return seconds * integer(times.BILLION, 64) + rest
    if isinstance(kind, value_types.BoolType):
        return bits != 0
    if isinstance(kind, value_types.FloatingType):
        return z3.fpBVToFP(bits, DOUBLE if kind.bits == 64 else SINGLE)
    if not isinstance(kind, value_types.IntegerType):
        raise UnknownError(f"a value of type {kind}")
    missing = width(kind) - bits.size()
    return bits if not missing else (z3.SignExt if kind.signed else z3.ZeroExt)(missing, bits)


def parts(value: Term) -> tuple[Term, Term]:
    billion = integer(times.BILLION, 64)
    rest = z3.SRem(value, billion)
    rest = z3.If(rest < 0, rest + billion, rest)
    return (value - rest) / billion, rest


def whole_number(value: int, kind: Type) -> Term:
    return z3.BoolVal(bool(value)) if isinstance(kind, value_types.BoolType) else integer(value, width(kind))


def choose(second: Term, values: Sequence[Term]) -> Term:
    return z3.If(second, values[1], values[0])


def _bits(value: Term) -> int:
    return 64 if value.sort() == DOUBLE else 32


def compare_terms(operator: str, left: Term, right: Term, kind: Type) -> Term:
    if isinstance(kind, value_types.BoolType) and operator not in ("==", "!="):
        left, right = map(as_bits, (left, right))
    if isinstance(kind, value_types.FloatingType):
        result: Term = _COMPARED_FLOATS[operator](left, right)
        return opposite(result) if operator == "!=" else result
    return (_COMPARED if is_signed(kind) else _COMPARED_UNSIGNED)[operator](left, right)


_COMPARED: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "==": lambda left, right: left == right,
        "!=": lambda left, right: opposite(left == right),
        "<": lambda left, right: left < right,
        ">": lambda left, right: left > right,
        "<=": lambda left, right: left <= right,
        ">=": lambda left, right: left >= right,
    }
)
_COMPARED_UNSIGNED = MappingProxyType(
    {**_COMPARED, "<": z3.ULT, ">": z3.UGT, "<=": z3.ULE, ">=": z3.UGE},
)
_COMPARED_FLOATS = MappingProxyType(
    {"==": z3.fpEQ, "!=": z3.fpEQ, "<": z3.fpLT, ">": z3.fpGT, "<=": z3.fpLEQ, ">=": z3.fpGEQ}
)
OF_INTEGERS: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "+": lambda left, right: left + right,
        "-": lambda left, right: left - right,
        "*": lambda left, right: left * right,
        "&": lambda left, right: left & right,
        "|": lambda left, right: left | right,
        "^": lambda left, right: left ^ right,
    }
)
OF_FLOATS = MappingProxyType({"+": z3.fpAdd, "-": z3.fpSub, "*": z3.fpMul, "/": z3.fpDiv})
ROUNDED: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "h_sqrt": lambda value: z3.fpSqrt(NEAREST, value),
        "h_fabs": z3.fpAbs,
        "h_floor": lambda value: z3.fpRoundToIntegral(z3.RTN(), value),
        "h_ceil": lambda value: z3.fpRoundToIntegral(z3.RTP(), value),
        "h_trunc": lambda value: z3.fpRoundToIntegral(z3.RTZ(), value),
        "h_rint": lambda value: z3.fpRoundToIntegral(NEAREST, value),
        "h_nearbyint": lambda value: z3.fpRoundToIntegral(NEAREST, value),
    }
)
QUESTIONS: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "h_isnan": lambda value: opposite(z3.fpLEQ(z3.fpAbs(value), floating(inf, _bits(value)))),
        "h_isinf": lambda value: z3.fpEQ(z3.fpAbs(value), floating(inf, _bits(value))),
        "h_isfinite": lambda value: z3.fpLT(z3.fpAbs(value), floating(inf, _bits(value))),
    }
)
"""Comparisons with infinity, as in the module: if z3 knows nothing about floats, only equal terms are equal."""
