"""Compile functions that every specification can call: `<math.h>`, `std::min`, `std::to_string`, `strcpy`, …"""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from rosmop.check import function_library
from rosmop.check.assignables import Value
from rosmop.check.assignments import require_original, store
from rosmop.check.conversion import convert, number, require_number
from rosmop.check.print_statements import compile_format
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.runtime import numbers, strings
from rosmop.types import value_types


class Arguments:
    def __init__(
        self,
        scope: FunctionScope,
        parts: tuple[str, ...],
        values: Sequence[Value],
        position: Position,
        site: int,
    ) -> None:
        self.scope = scope
        self.name = "::".join(parts)
        self.values = values
        self.position = position
        self.site = site

    def count(self, least: int, most: int | None = None) -> None:
        most = least if most is None else most
        if not least <= len(self.values) <= most:
            wanted = str(least) if most == least else f"{least} to {most}"
            raise SpecificationError.at(
                self.position, f"`{self.name}` takes {wanted} argument(s), not {len(self.values)}"
            )

    def text(self, index: int) -> nodes.Expression:
        return convert(self.scope, self.values[index], value_types.STRING)

    def result(self, result: nodes.Expression) -> Value:
        return Value(result, self.position)

    def value(self, kind: value_types.Type, function: str, *arguments: nodes.Expression) -> Value:
        return self.result(nodes.Call(kind, function, arguments, self.site))


Function = Callable[[Arguments], Value]


def find_function(parts: tuple[str, ...], *, is_library: bool = False) -> Function | None:
    """Return a function by its name, with or without `std::`. The library itself (`is_library`) also has `INTERNAL`."""
    if parts[0] == "std" and len(parts) == 2:
        parts = parts[1:]
    if len(parts) != 1:
        return None
    return LIBRARY.get(parts[0]) or (INTERNAL.get(parts[0]) if is_library else None)


def _math(name: str, count: int) -> Function:
    def function(call: Arguments) -> Value:
        call.count(count)
        for value in call.values:
            require_number(value, f"`{call.name}`")
        if all(value.type == value_types.FLOAT for value in call.values):  # C++ has an overload for floats
            return call.value(value_types.FLOAT, f"h_{name}f", *(value.form for value in call.values))
        doubles = [number(value.form, value_types.DOUBLE) for value in call.values]
        return call.value(value_types.DOUBLE, f"h_{name}", *doubles)

    return function


def _elementary(name: str) -> Function:
    function = _math(name, numbers.MATH[name][0])

    def of_doubles(call: Arguments) -> Value:
        value = function(call)
        if value.type == value_types.FLOAT:
            return value
        return call.result(function_library.invoke(call.scope, name, call.values))

    return of_doubles


def _math_of_floats(name: str, count: int) -> Function:
    function = _math(name, count)

    def of_floats(call: Arguments) -> Value:
        call.values = [
            Value(number(value.form, value_types.FLOAT), value.position)
            if value_types.is_number(value.type)
            else value
            for value in call.values
        ]
        return function(call)

    return of_floats


def _rounded(name: str) -> Function:
    function = _math(name, 1)

    def to_integer(call: Arguments) -> Value:
        return call.result(number(function(call).form, value_types.LONG))

    return to_integer


def _absolute_of_long(call: Arguments) -> Value:
    for value in call.values:
        require_number(value, "`labs`")
    call.values = [Value(number(value.form, value_types.LONG), value.position) for value in call.values]
    return _absolute(call)


def _absolute(call: Arguments) -> Value:
    call.count(1)
    require_number(call.values[0], "`abs`")
    kind = value_types.promote(call.values[0].type)
    return call.result(nodes.Unary(kind, "abs", number(call.values[0].form, kind)))


def _extreme(name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(2)
        left, right = call.values
        if value_types.is_number(left.type) and value_types.is_number(right.type):
            kind = left.type if left.type == right.type else value_types.common(left.type, right.type)
            return call.value(kind, f"h_{name}", *(number(value.form, kind) for value in call.values))
        if left.type != right.type or not isinstance(
            left.type, value_types.StringType | value_types.TimeType | value_types.DurationType
        ):
            raise SpecificationError.at(
                call.position, f"`{call.name}` has no meaning for {left.type} and {right.type}"
            )
        first = left.form
        if isinstance(left.type, value_types.StringType):
            first = nodes.Call(left.type, "o_charged", (first,), call.site)
        return call.value(left.type, f"h_{name}", first, right.form)

    return function


def _question(name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        require_number(call.values[0], f"`{name}`")
        return call.value(value_types.BOOL, f"h_{name}", call.values[0].form)

    return function


def _finite(call: Arguments) -> Value:
    call.count(1)
    if isinstance(call.values[0].type, value_types.RecordType | value_types.VectorType):
        return call.result(function_library.all_finite(call.scope, call.values[0]))
    return _question("isfinite")(call)


def _of_library(name: str, *wanted: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(len(wanted))
        for value, kind in zip(call.values, wanted, strict=True):
            if not _FITS[kind](value.type):
                raise SpecificationError.at(
                    value.position, f"`{call.name}` needs {kind} here; this is {value.type}"
                )
            if kind == _POLYGON:
                function_library.check_polygon(value)
        return call.result(function_library.invoke(call.scope, name, call.values))

    return function


_NUMBER, _POLYGON, _NAMES = "a number", "the corners of a polygon, a list of numbers,", "a list of strings"
_QUATERNION, _TEXT = "a geometry_msgs/Quaternion", "a string"
_FITS: Mapping[str, Callable[[value_types.Type], bool]] = MappingProxyType(
    {
        _NUMBER: value_types.is_number,
        _POLYGON: function_library.is_polygon,
        _NAMES: function_library.is_names,
        _QUATERNION: function_library.is_quaternion,
        _TEXT: lambda kind: isinstance(kind, value_types.StringType),
    }
)


def _nearest(call: Arguments) -> Value:
    call.count(3)
    if not function_library.is_polygon(call.values[0].type):
        raise SpecificationError.at(
            call.values[0].position, f"`nearest` needs a list of numbers here; this is {call.values[0].type}"
        )
    for value in call.values[1:]:
        require_number(value, "`nearest`")
    limits = (number(value.form, value_types.LONG) for value in call.values[1:])
    return call.value(value_types.DOUBLE, "l_nearest", call.values[0].form, *limits)


def _to_string(call: Arguments) -> Value:
    call.count(1)
    value = call.values[0]
    require_number(value, "`std::to_string`")
    floating = isinstance(value.type, value_types.FloatingType)
    return call.value(value_types.STRING, f"h_to_{'floating' if floating else 'integer'}", value.form)


def _parser(kind: value_types.IntegerType) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1, 3)
        if len(call.values) > 1 and call.values[1].constant != 0:
            raise SpecificationError.at(call.values[1].position, "the second argument must be 0")
        base = call.values[2].constant if len(call.values) > 2 else 10
        if base not in (2, 8, 10, 16):
            raise SpecificationError.at(call.values[2].position, "the base must be 2, 8, 10 or 16")
        limits = (nodes.Literal(kind, number) for number in (kind.least, kind.most))
        return call.value(kind, "h_parse", call.text(0), nodes.Literal(value_types.INT, base), *limits)

    return function


def _parse_floating(kind: value_types.FloatingType) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        return call.value(kind, "h_parse_floating", call.text(0), nodes.Literal(value_types.INT, kind.bits))

    return function


def _lenient(kind: value_types.Type, name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        wide = value_types.LONG if isinstance(kind, value_types.IntegerType) else kind
        return call.result(number(nodes.Call(wide, f"h_{name}", (call.text(0),)), kind))

    return function


def _compare(call: Arguments) -> Value:
    call.count(2)
    charged = nodes.Call(value_types.STRING, "o_charged", (call.text(0),), call.site)
    return call.value(value_types.INT, "h_compare", charged, call.text(1))


def _length(call: Arguments) -> Value:
    call.count(1)
    return call.value(value_types.ULONG, "h_len", call.text(0))


def _buffer(call: Arguments) -> Value:
    target = call.values[0]
    if not isinstance(target.type, value_types.CharactersType):
        raise SpecificationError.at(
            target.position, f"`{call.name}` needs a `char` buffer; for a {target.type} write `=` or `+=`"
        )
    require_original(target)
    return target


def _fills(function: str) -> Function:
    def fill(call: Arguments) -> Value:
        call.count(2)
        target = _buffer(call)
        return _store(call, target, function, call.text(1))

    return fill


def _fills_at_most(call: Arguments) -> Value:
    call.count(3)
    target = _buffer(call)
    limit = number(call.values[2].form, value_types.ULONG)
    return _store(call, target, "h_filled_at_most", call.text(1), limit)


def _store(call: Arguments, target: Value, function: str, *arguments: nodes.Expression) -> Value:
    filled = nodes.Call(value_types.CHARACTERS, function, (target.form, *arguments), call.site)
    return Value(store(call.scope, target, filled), call.position)


def _prints(call: Arguments) -> Value:
    call.count(2, 100)
    target = _buffer(call)
    return _print(call, target, "h_filled", compile_format(call.scope, call.values[1], call.values[2:]))


def _prints_at_most(call: Arguments) -> Value:
    call.count(3, 100)
    target = _buffer(call)
    limit = number(call.values[1].form, value_types.ULONG)
    text = compile_format(call.scope, call.values[2], call.values[3:])
    return _print(call, target, "h_printed", text, limit)


def _print(
    call: Arguments, target: Value, function: str, text: nodes.Expression, *arguments: nodes.Expression
) -> Value:
    made = nodes.Read(value_types.STRING, call.scope.temporary())
    filled = _store(call, target, function, made, *arguments)
    length = nodes.Call(value_types.INT, "h_len", (made,))
    items = (nodes.Assign(value_types.STRING, made.name, text), filled.form, length)
    return Value(nodes.Sequence(value_types.INT, items, -1), call.position)


LIBRARY: Mapping[str, Function] = MappingProxyType(
    {
        **{name: _math(name, count) for name, (count, _) in numbers.MATH.items()},
        **{name: _elementary(name) for name in function_library.ELEMENTARY},
        "abs": _absolute,
        "labs": _absolute_of_long,
        "llabs": _absolute_of_long,
        "min": _extreme("min"),
        "max": _extreme("max"),
        **{f"{name}f": _math_of_floats(name, count) for name, (count, _) in numbers.MATH.items()},
        **{f"{long}round": _rounded("round") for long in ("l", "ll")},
        **{f"{long}rint": _rounded("rint") for long in ("l", "ll")},
        "signbit": _question("signbit"),
        "isnan": _question("isnan"),
        "isinf": _question("isinf"),
        "isfinite": _finite,
        "clamp": _of_library("clamp", _NUMBER, _NUMBER, _NUMBER),
        "inside": _of_library("inside", _NUMBER, _NUMBER, _POLYGON),
        "distance": _of_library("distance", _NUMBER, _NUMBER, _POLYGON),
        "yaw": _of_library("yaw", _QUATERNION),
        "metres_east": _of_library("metres_east", _NUMBER, _NUMBER, _NUMBER, _NUMBER),
        "metres_north": _of_library("metres_north", _NUMBER, _NUMBER, _NUMBER, _NUMBER),
        "index": _of_library("index", _NAMES, _TEXT),
        "sender": _of_library("sender", _TEXT, _TEXT),
        "silence": _of_library("silence", _TEXT, _TEXT, _TEXT, _NUMBER, _NUMBER),
        "intrusion": _of_library("intrusion", _TEXT, _TEXT, _TEXT, _NUMBER, _NUMBER),
        "nearest": _nearest,
        "to_string": _to_string,
        "stoi": _parser(value_types.INT),
        "stol": _parser(value_types.LONG),
        "stoll": _parser(value_types.LONG),
        "stoul": _parser(value_types.ULONG),
        "stoull": _parser(value_types.ULONG),
        "stof": _parse_floating(value_types.FLOAT),
        "stod": _parse_floating(value_types.DOUBLE),
        "atoi": _lenient(value_types.INT, "atoi"),
        "atol": _lenient(value_types.LONG, "atoi"),
        "atof": _lenient(value_types.DOUBLE, "atof"),
        "strcmp": _compare,
        "strlen": _length,
        "strcpy": _fills("h_filled"),
        "strcat": _fills("h_extended"),
        "strncpy": _fills_at_most,
        "sprintf": _prints,
        "snprintf": _prints_at_most,
    }
)

INTERNAL: Mapping[str, Function] = MappingProxyType(
    {
        "turned": _of_library("turned", _NUMBER, _NUMBER),
        "sin_of_c": lambda call: call.value(
            value_types.DOUBLE, "h_sin_of_a_large_angle", call.values[0].form
        ),
        "cos_of_c": lambda call: call.value(
            value_types.DOUBLE, "h_cos_of_a_large_angle", call.values[0].form
        ),
    }
)
"""Functions that only functions of the library call. Modules leave messages with angles that need the C library."""

_LIMITED: Mapping[str, value_types.IntegerType] = MappingProxyType(
    {
        "SCHAR": value_types.INT8,
        "UCHAR": value_types.UINT8,
        "CHAR": value_types.CHAR,
        "SHRT": value_types.INT16,
        "USHRT": value_types.UINT16,
        "INT": value_types.INT,
        "UINT": value_types.UINT,
        "LONG": value_types.LONG,
        "ULONG": value_types.ULONG,
        "LLONG": value_types.LONG,
        "ULLONG": value_types.ULONG,
        "INT8": value_types.INT8,
        "UINT8": value_types.UINT8,
        "INT16": value_types.INT16,
        "UINT16": value_types.UINT16,
        "INT32": value_types.INT,
        "UINT32": value_types.UINT,
        "INT64": value_types.LONG,
        "UINT64": value_types.ULONG,
        "SIZE": value_types.ULONG,
    }
)

CONSTANTS: Mapping[tuple[str, ...], tuple[value_types.Type, bool | int | float]] = MappingProxyType(
    {
        ("true",): (value_types.BOOL, True),
        ("false",): (value_types.BOOL, False),
        ("M_PI",): (value_types.DOUBLE, math.pi),
        ("M_PI_2",): (value_types.DOUBLE, math.pi / 2),
        ("M_PI_4",): (value_types.DOUBLE, math.pi / 4),
        ("M_1_PI",): (value_types.DOUBLE, 1 / math.pi),
        ("M_E",): (value_types.DOUBLE, math.e),
        ("M_SQRT2",): (value_types.DOUBLE, math.sqrt(2)),
        ("M_SQRT1_2",): (value_types.DOUBLE, math.sqrt(0.5)),
        ("M_2_PI",): (value_types.DOUBLE, 2 / math.pi),
        ("M_2_SQRTPI",): (value_types.DOUBLE, 2 / math.sqrt(math.pi)),
        ("M_LN2",): (value_types.DOUBLE, math.log(2)),
        ("M_LN10",): (value_types.DOUBLE, math.log(10)),
        ("M_LOG2E",): (value_types.DOUBLE, 1.4426950408889634),
        ("M_LOG10E",): (value_types.DOUBLE, 0.4342944819032518),
        **{
            (f"{name}_{end}",): (kind if kind.bits >= 32 else value_types.INT, limit)
            for name, kind in _LIMITED.items()
            for end, limit in (("MIN", kind.least), ("MAX", kind.most))
            if kind.signed or end == "MAX"
        },
        ("FLT_MIN",): (value_types.FLOAT, 1.1754943508222875e-38),
        ("INFINITY",): (value_types.FLOAT, math.inf),
        ("HUGE_VAL",): (value_types.DOUBLE, math.inf),
        ("NAN",): (value_types.FLOAT, math.nan),
        ("DBL_MAX",): (value_types.DOUBLE, 1.7976931348623157e308),
        ("DBL_MIN",): (value_types.DOUBLE, 2.2250738585072014e-308),
        ("DBL_EPSILON",): (value_types.DOUBLE, 2.220446049250313e-16),
        ("FLT_MAX",): (value_types.FLOAT, 3.4028234663852886e38),
        ("FLT_EPSILON",): (value_types.FLOAT, 1.1920928955078125e-07),
        ("std", "string", "npos"): (value_types.ULONG, strings.NOT_FOUND),
        ("string", "npos"): (value_types.ULONG, strings.NOT_FOUND),
    }
)
