"""Functions that every specification can call: `<math.h>`, `std::min`, `std::to_string`, `strcpy`, …"""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from rosmop.check.assignments import require_original, store
from rosmop.check.conversion import convert, number, require_number
from rosmop.check.output import formatted
from rosmop.check.places import Value
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.form.positions import Position
from rosmop.runtime import numbers, strings
from rosmop.text.errors import SpecificationError
from rosmop.types import kinds


class Arguments:
    """The arguments of a call, where it stands, and what it is called."""

    def __init__(
        self, scope: Scope, parts: tuple[str, ...], values: Sequence[Value], position: Position, site: int
    ) -> None:
        self.scope = scope
        self.name = "::".join(parts)
        self.values = values
        self.position = position
        self.site = site

    def count(self, least: int, most: int | None = None) -> None:
        """Refuse another number of arguments."""
        most = least if most is None else most
        if not least <= len(self.values) <= most:
            wanted = str(least) if most == least else f"{least} to {most}"
            raise SpecificationError.at(
                self.position, f"`{self.name}` takes {wanted} argument(s), not {len(self.values)}"
            )

    def text(self, index: int) -> nodes.Expression:
        """An argument as a string."""
        return convert(self.scope, self.values[index], kinds.STRING)

    def result(self, result: nodes.Expression) -> Value:
        """The result of a function without effects."""
        return Value(result, self.position)

    def value(self, kind: kinds.Type, function: str, *arguments: nodes.Expression) -> Value:
        """The same, by a function of the form."""
        return self.result(nodes.Call(kind, function, arguments, self.site))


Function = Callable[[Arguments], Value]


def find_function(parts: tuple[str, ...]) -> Function | None:
    """The library function of this name, with or without `std::`."""
    if parts[0] == "std" and len(parts) == 2:
        parts = parts[1:]
    return LIBRARY.get(parts[0]) if len(parts) == 1 else None


def _math(name: str, count: int) -> Function:
    def function(call: Arguments) -> Value:
        call.count(count)
        for value in call.values:
            require_number(value, f"`{call.name}`")
        if all(value.type == kinds.FLOAT for value in call.values):  # C++ has an overload for them
            return call.value(kinds.FLOAT, f"h_{name}f", *(value.form for value in call.values))
        doubles = [number(value.form, kinds.DOUBLE) for value in call.values]
        return call.value(kinds.DOUBLE, f"h_{name}", *doubles)

    return function


def _math_of_floats(name: str, count: int) -> Function:
    """`sqrtf` and its like."""
    function = _math(name, count)

    def of_floats(call: Arguments) -> Value:
        call.values = [
            Value(number(value.form, kinds.FLOAT), value.position) if kinds.is_number(value.type) else value
            for value in call.values
        ]
        return function(call)

    return of_floats


def _rounded(name: str) -> Function:
    """`lround` and its like."""
    function = _math(name, 1)

    def to_integer(call: Arguments) -> Value:
        return call.result(number(function(call).form, kinds.LONG))

    return to_integer


def _absolute_of_long(call: Arguments) -> Value:
    """`labs`: of an integer, whatever is given."""
    for value in call.values:
        require_number(value, "`labs`")
    call.values = [Value(number(value.form, kinds.LONG), value.position) for value in call.values]
    return _absolute(call)


def _absolute(call: Arguments) -> Value:
    call.count(1)
    require_number(call.values[0], "`abs`")
    kind = kinds.promoted(call.values[0].type)
    return call.result(nodes.Unary(kind, "abs", number(call.values[0].form, kind)))


def _extreme(name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(2)
        left, right = call.values
        if kinds.is_number(left.type) and kinds.is_number(right.type):
            kind = left.type if left.type == right.type else kinds.common(left.type, right.type)
            return call.value(kind, f"h_{name}", *(number(value.form, kind) for value in call.values))
        if left.type != right.type or not isinstance(left.type, kinds.String | kinds.Time | kinds.Duration):
            raise SpecificationError.at(
                call.position, f"`{call.name}` has no meaning for {left.type} and {right.type}"
            )
        first = left.form
        if isinstance(left.type, kinds.String):
            first = nodes.Call(left.type, "o_charged", (first,), call.site)
        return call.value(left.type, f"h_{name}", first, right.form)

    return function


def _question(name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        require_number(call.values[0], f"`{name}`")
        return call.value(kinds.BOOL, f"h_{name}", call.values[0].form)

    return function


def _to_string(call: Arguments) -> Value:
    call.count(1)
    value = call.values[0]
    require_number(value, "`std::to_string`")
    floating = isinstance(value.type, kinds.Floating)
    return call.value(kinds.STRING, f"h_to_{'floating' if floating else 'integer'}", value.form)


def _parser(kind: kinds.Integer) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1, 3)
        if len(call.values) > 1 and call.values[1].constant != 0:
            raise SpecificationError.at(call.values[1].position, "the second argument must be 0")
        base = call.values[2].constant if len(call.values) > 2 else 10
        if base not in (2, 8, 10, 16):
            raise SpecificationError.at(call.values[2].position, "the base must be 2, 8, 10 or 16")
        limits = (nodes.Literal(kind, number) for number in (kind.least, kind.most))
        return call.value(kind, "h_parse", call.text(0), nodes.Literal(kinds.INT, base), *limits)

    return function


def _parse_floating(kind: kinds.Floating) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        return call.value(kind, "h_parse_floating", call.text(0), nodes.Literal(kinds.INT, kind.bits))

    return function


def _lenient(kind: kinds.Type, name: str) -> Function:
    def function(call: Arguments) -> Value:
        call.count(1)
        wide = kinds.LONG if isinstance(kind, kinds.Integer) else kind
        return call.result(number(nodes.Call(wide, f"h_{name}", (call.text(0),)), kind))

    return function


def _compare(call: Arguments) -> Value:
    call.count(2)
    charged = nodes.Call(kinds.STRING, "o_charged", (call.text(0),), call.site)
    return call.value(kinds.INT, "h_compare", charged, call.text(1))


def _length(call: Arguments) -> Value:
    call.count(1)
    return call.value(kinds.ULONG, "h_len", call.text(0))


def _buffer(call: Arguments) -> Value:
    target = call.values[0]
    if not isinstance(target.type, kinds.Characters):
        raise SpecificationError.at(
            target.position, f"`{call.name}` needs a `char` buffer; for a {target.type} write `=` or `+=`"
        )
    require_original(target)
    return target


def _fills(function: str) -> Function:
    def fill(call: Arguments) -> Value:
        call.count(2)
        target = _buffer(call)
        return _stored(call, target, function, call.text(1))

    return fill


def _fills_at_most(call: Arguments) -> Value:
    call.count(3)
    target = _buffer(call)
    limit = number(call.values[2].form, kinds.ULONG)
    return _stored(call, target, "h_filled_at_most", call.text(1), limit)


def _stored(call: Arguments, target: Value, function: str, *arguments: nodes.Expression) -> Value:
    """The buffer after a function of the form has filled it."""
    filled = nodes.Call(kinds.CHARACTERS, function, (target.form, *arguments), call.site)
    return Value(store(call.scope, target, filled), call.position)


def _prints(call: Arguments) -> Value:
    call.count(2, 100)
    target = _buffer(call)
    return _printed(call, target, "h_filled", formatted(call.scope, call.values[1], call.values[2:]))


def _prints_at_most(call: Arguments) -> Value:
    call.count(3, 100)
    target = _buffer(call)
    limit = number(call.values[1].form, kinds.ULONG)
    text = formatted(call.scope, call.values[2], call.values[3:])
    return _printed(call, target, "h_printed", text, limit)


def _printed(
    call: Arguments, target: Value, function: str, text: nodes.Expression, *arguments: nodes.Expression
) -> Value:
    """The length of a text that a function of the form puts into a buffer."""
    made = nodes.Read(kinds.STRING, call.scope.temporary())
    filled = _stored(call, target, function, made, *arguments)
    length = nodes.Call(kinds.INT, "h_len", (made,))
    items = (nodes.Assign(kinds.STRING, made.name, text), filled.form, length)
    return Value(nodes.Sequence(kinds.INT, items, -1), call.position)


LIBRARY: Mapping[str, Function] = MappingProxyType(
    {
        **{name: _math(name, count) for name, (count, _) in numbers.MATH.items()},
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
        "isfinite": _question("isfinite"),
        "to_string": _to_string,
        "stoi": _parser(kinds.INT),
        "stol": _parser(kinds.LONG),
        "stoll": _parser(kinds.LONG),
        "stoul": _parser(kinds.ULONG),
        "stoull": _parser(kinds.ULONG),
        "stof": _parse_floating(kinds.FLOAT),
        "stod": _parse_floating(kinds.DOUBLE),
        "atoi": _lenient(kinds.INT, "atoi"),
        "atol": _lenient(kinds.LONG, "atoi"),
        "atof": _lenient(kinds.DOUBLE, "atof"),
        "strcmp": _compare,
        "strlen": _length,
        "strcpy": _fills("h_filled"),
        "strcat": _fills("h_extended"),
        "strncpy": _fills_at_most,
        "sprintf": _prints,
        "snprintf": _prints_at_most,
    }
)

_LIMITED: Mapping[str, kinds.Integer] = MappingProxyType(
    {
        "SCHAR": kinds.INT8, "UCHAR": kinds.UINT8, "CHAR": kinds.CHAR, "SHRT": kinds.INT16, "USHRT": kinds.UINT16,
        "INT": kinds.INT, "UINT": kinds.UINT, "LONG": kinds.LONG, "ULONG": kinds.ULONG, "LLONG": kinds.LONG,
        "ULLONG": kinds.ULONG, "INT8": kinds.INT8, "UINT8": kinds.UINT8, "INT16": kinds.INT16, "UINT16": kinds.UINT16,
        "INT32": kinds.INT, "UINT32": kinds.UINT, "INT64": kinds.LONG, "UINT64": kinds.ULONG, "SIZE": kinds.ULONG,
    }
)  # fmt: skip
"""The types whose limits have names, such as `INT_MAX`."""

CONSTANTS: Mapping[tuple[str, ...], tuple[kinds.Type, bool | int | float]] = MappingProxyType(
    {
        ("true",): (kinds.BOOL, True),
        ("false",): (kinds.BOOL, False),
        ("M_PI",): (kinds.DOUBLE, math.pi),
        ("M_PI_2",): (kinds.DOUBLE, math.pi / 2),
        ("M_PI_4",): (kinds.DOUBLE, math.pi / 4),
        ("M_1_PI",): (kinds.DOUBLE, 1 / math.pi),
        ("M_E",): (kinds.DOUBLE, math.e),
        ("M_SQRT2",): (kinds.DOUBLE, math.sqrt(2)),
        ("M_SQRT1_2",): (kinds.DOUBLE, math.sqrt(0.5)),
        ("M_2_PI",): (kinds.DOUBLE, 2 / math.pi),
        ("M_2_SQRTPI",): (kinds.DOUBLE, 2 / math.sqrt(math.pi)),
        ("M_LN2",): (kinds.DOUBLE, math.log(2)),
        ("M_LN10",): (kinds.DOUBLE, math.log(10)),
        ("M_LOG2E",): (kinds.DOUBLE, 1.4426950408889634),
        ("M_LOG10E",): (kinds.DOUBLE, 0.4342944819032518),
        **{
            (f"{name}_{end}",): (kind if kind.bits >= 32 else kinds.INT, getattr(kind, value))
            for name, kind in _LIMITED.items()
            for end, value in (("MIN", "least"), ("MAX", "most"))
            if kind.signed or end == "MAX"
        },
        ("FLT_MIN",): (kinds.FLOAT, 1.1754943508222875e-38),
        ("INFINITY",): (kinds.FLOAT, math.inf),
        ("HUGE_VAL",): (kinds.DOUBLE, math.inf),
        ("NAN",): (kinds.FLOAT, math.nan),
        ("DBL_MAX",): (kinds.DOUBLE, 1.7976931348623157e308),
        ("DBL_MIN",): (kinds.DOUBLE, 2.2250738585072014e-308),
        ("DBL_EPSILON",): (kinds.DOUBLE, 2.220446049250313e-16),
        ("FLT_MAX",): (kinds.FLOAT, 3.4028234663852886e38),
        ("FLT_EPSILON",): (kinds.FLOAT, 1.1920928955078125e-07),
        ("std", "string", "npos"): (kinds.ULONG, strings.NOT_FOUND),
        ("string", "npos"): (kinds.ULONG, strings.NOT_FOUND),
    }
)
