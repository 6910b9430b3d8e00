"""Conversions between types as code: what C++ does when a value meets a variable of another type."""

from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import numbers, texts, vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

FUNCTIONS = {
    "c_f32": numbers.f32,
    "c_f32_integer": numbers.f32_of_integer,
    "c_truncate": numbers.truncate,
    "c_terminated": texts.terminated,
    "c_float": float,
    "c_recast": vectors.recast,
    "c_recast_each": vectors.recast_each,
    "c_signed": vectors.signed,
    "c_unsigned": vectors.unsigned,
    "c_truths": vectors.truths,
}


def convert(scope: Scope, value: Value, target: Type, site: int | None = None) -> str:
    """Code for the value as one of the target type, which nothing else refers to; refuses what cannot be."""
    check_convertible(value, target)
    if kinds.is_number(target):
        return number(value.code, value.type, target)
    if isinstance(target, kinds.String) and isinstance(value.type, kinds.Characters):
        where = scope.lines.site if site is None else site
        return f"c_terminated({scope.context}, {value.code}, {where})"
    if isinstance(target, kinds.Characters) and isinstance(value.type, kinds.String):
        return f"({value.code} + b'\\0')"
    where = scope.lines.site if site is None else site
    if isinstance(value.type, kinds.Vector) and isinstance(target, kinds.Vector):
        recast = _recast(scope.context, value.code, value.type.element, target.element, where)
        if recast is not None:
            return recast
    if value.owned:
        return value.code
    return scope.codecs.copy(value.type, scope.context, value.code, where)


def _recast(context: str, code: str, source: Type, target: Type, site: int) -> str | None:
    """Code for a vector with other elements than it has (bytes of another kind); None if they are the same."""
    if source == target:
        return None
    if isinstance(source, kinds.Vector) and isinstance(target, kinds.Vector):
        inner = _recast(context, "e", source.element, target.element, site)
        return None if inner is None else f"c_recast_each({context}, {code}, lambda e: {inner}, {site})"
    if isinstance(target, kinds.Bool):
        name = "c_truths"
    else:
        assert isinstance(target, kinds.Integer)  # so says kinds.same_elements
        name = "c_signed" if target.signed else "c_unsigned"
    return f"c_recast({context}, {code}, {name}, {site})"


def check_convertible(value: Value, target: Type) -> None:
    """Refuse a value that can never be one of the target type."""
    if not kinds.convertible(value.type, target):
        raise SpecificationError.at(value.position, refusal(value.type, target))


def refusal(source: Type, target: Type) -> str:
    """Why a value of one type cannot become one of another, and what to write."""
    text, moment = (kinds.String, kinds.Characters), (kinds.Time, kinds.Duration)
    hints = (
        (isinstance(target, text) and kinds.is_number(source), "write `std::to_string(…)`"),
        (kinds.is_number(target) and isinstance(source, text), "write `std::stod(…)` or `std::stoi(…)`"),
        (kinds.is_number(target) and isinstance(source, moment), "write `.toSec()`, `.sec` or `.nsec`"),
        (isinstance(target, moment) and kinds.is_number(source), f"write `{target}(…)`"),
        (isinstance(source, kinds.Vector) and not isinstance(target, kinds.Vector), "write an index, `[0]`"),
        (isinstance(source, kinds.Record) and not isinstance(target, kinds.Record), "write a field, `.data`"),
    )
    if isinstance(source, kinds.Void):
        return "this function has no value"
    hint = next((hint for fits, hint in hints if fits), "")
    return f"{source} cannot become {target}" + (f"; {hint}" if hint else "")


def number(code: str, source: Type, target: Type) -> str:
    """Code for a number as one of another type."""
    if source == target:
        return code
    if isinstance(target, kinds.Bool):
        return f"({code} != 0)"
    if isinstance(target, kinds.Integer):
        return _to_integer(code, source, target)
    assert isinstance(target, kinds.Floating)  # numbers are one of the three
    if target.bits == 32:
        large = isinstance(source, kinds.Integer) and source.bits == 64
        return f"c_f32_integer({code})" if large else f"c_f32({code})"
    return code if isinstance(source, kinds.Floating) else f"c_float({code})"


def _to_integer(code: str, source: Type, target: kinds.Integer) -> str:
    if isinstance(source, kinds.Bool):
        return f"(+{code})"
    if isinstance(source, kinds.Floating):
        return f"c_truncate({code}, {target.least}, {target.most})"
    assert isinstance(source, kinds.Integer)
    return code if target.holds(source) else wrapped(code, target)


def wrapped(code: str, kind: kinds.Integer) -> str:
    """Code for an integer that may have overflowed, wrapped into its type."""
    mask = (1 << kind.bits) - 1
    if not kind.signed:
        return f"({code} & {mask})"
    half = 1 << (kind.bits - 1)
    return f"(({code} + {half} & {mask}) - {half})"


def condition(value: Value) -> str:
    """Code for a value as a condition."""
    if isinstance(value.type, kinds.Bool):
        return value.code
    if not kinds.is_number(value.type):
        hint = (
            "; write `.empty()` or compare it" if isinstance(value.type, kinds.String | kinds.Vector) else ""
        )
        raise SpecificationError.at(value.position, f"{value.type} is no condition{hint}")
    return f"({value.code} != 0)"


def literal(constant: bool | int | float | bytes) -> str:
    """Code for a constant."""
    if isinstance(constant, float):
        if constant != constant:  # noqa: PLR0124  NaN
            return "c_nan"
        if constant - constant != 0:
            return "c_inf" if constant > 0 else "(-c_inf)"
        return repr(constant) if constant >= 0 and repr(constant)[0] != "-" else f"({constant!r})"
    if isinstance(constant, int) and not isinstance(constant, bool) and constant < 0:
        return f"({constant})"
    return repr(constant)


def constant_value(position: Position, kind: Type, constant: bool | int | float | bytes) -> Value:
    """A value that is known."""
    return Value(kind, literal(constant), position, constant=constant)


def require_number(value: Value, what: str) -> None:
    """Refuse what is not a number."""
    if not kinds.is_number(value.type):
        raise SpecificationError.at(value.position, f"{what} needs a number; this is {value.type}")
