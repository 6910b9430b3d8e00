"""Literals: the bytes of a string, the value of a character, the nanoseconds of a duration."""

import re
from fractions import Fraction

_ESCAPE = re.compile(r"\\(x[0-9A-Fa-f]{1,2}|[0-7]{1,3}|.)", re.DOTALL)
_SIMPLE = {"n": 10, "t": 9, "r": 13, "a": 7, "b": 8, "f": 12, "v": 11, "\\": 92, "'": 39, '"': 34, "?": 63}
_UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "": 10**9, "m": 60 * 10**9, "min": 60 * 10**9,
             "h": 3600 * 10**9}  # fmt: skip
_DURATION = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]*)\Z")
MIN_PERIOD_NS = 10**6
MAX_PERIOD_NS = 10**18
"""About 31 years."""


class BadLiteralError(Exception):
    """A literal that means nothing; the text says what to write instead."""


def string_bytes(inner: str) -> bytes:
    """The bytes of a string literal, given what stands between its quotes."""
    result = bytearray()
    last = 0
    for found in _ESCAPE.finditer(inner):
        result += inner[last : found.start()].encode("utf-8", "surrogatepass")
        result.append(_escaped(found[1]))
        last = found.end()
    return bytes(result + inner[last:].encode("utf-8", "surrogatepass"))


def character_value(inner: str) -> int:
    """The value of a character literal as a signed char."""
    value = string_bytes(inner)
    if len(value) != 1:
        raise BadLiteralError("a character outside ASCII is more than one char; write a string")
    return value[0] - 256 if value[0] > 127 else value[0]


def duration_ns(text: str) -> int:
    """The nanoseconds of a duration such as `100ms`, `0.5 s` or `2`."""
    found = _DURATION.match(text)
    if found is None or len(found[1]) > 30:
        raise BadLiteralError("this is no duration; write for example `100ms`, `0.5s` or `2m`")
    if found[2] not in _UNITS_NS:
        units = ", ".join(unit for unit in _UNITS_NS if unit)
        raise BadLiteralError(f"`{found[2][:20]}` is no unit of time; write one of {units}")
    number = found[1] if found[1][0] != "." else "0" + found[1]
    result = Fraction(number.rstrip(".") if number.endswith(".") else number) * _UNITS_NS[found[2]]
    if result.denominator != 1 or not MIN_PERIOD_NS <= result <= MAX_PERIOD_NS:
        raise BadLiteralError("a period is from 1 ms to 31 years, and a whole number of nanoseconds")
    return int(result)


def _escaped(code: str) -> int:
    if code[0] == "x" and len(code) > 1:
        return int(code[1:], 16)
    if code[0] in "01234567":
        return int(code, 8) & 0xFF
    if code not in _SIMPLE:
        raise BadLiteralError(f"`\\{code}` is no escape; write `\\\\` for a backslash")
    return _SIMPLE[code]
