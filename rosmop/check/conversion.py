"""Conversions between types: what C++ does when a value meets a variable of another type."""

from rosmop.check.assignables import Value
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.form.positions import Position
from rosmop.text.errors import SpecificationError
from rosmop.types import value_types
from rosmop.types.value_types import Type


def convert(scope: Scope, value: Value, target: Type, site: int | None = None) -> nodes.Expression:
    """The value as one of the target type, which nothing else refers to; refuses what cannot be."""
    check_convertible(value, target)
    if value_types.is_number(target):
        return number(value.form, target)
    where = scope.lines.site if site is None else site
    if isinstance(target, value_types.String) and isinstance(value.type, value_types.Characters):
        return nodes.Call(target, "c_terminated", (value.form,), where)
    if isinstance(target, value_types.Characters) and isinstance(value.type, value_types.String):
        return nodes.Call(target, "t_zeroed", (value.form,))
    if (
        isinstance(value.type, value_types.Vector)
        and isinstance(target, value_types.Vector)
        and value.type.element != target.element
    ):
        return nodes.Recast(target, value.form, where)
    if value.owned or value_types.is_scalar(value.type):
        return value.form
    return nodes.Copy(value.type, value.form, where)


def check_convertible(value: Value, target: Type) -> None:
    """Refuse a value that can never be one of the target type."""
    if not value_types.convertible(value.type, target):
        raise SpecificationError.at(value.position, refusal(value.type, target))


def refusal(source: Type, target: Type) -> str:
    """Why a value of one type cannot become one of another, and what to write."""
    text, moment = (value_types.String, value_types.Characters), (value_types.Time, value_types.Duration)
    hints = (
        (isinstance(target, text) and value_types.is_number(source), "write `std::to_string(…)`"),
        (
            value_types.is_number(target) and isinstance(source, text),
            "write `std::stod(…)` or `std::stoi(…)`",
        ),
        (value_types.is_number(target) and isinstance(source, moment), "write `.toSec()`, `.sec` or `.nsec`"),
        (isinstance(target, moment) and value_types.is_number(source), f"write `{target}(…)`"),
        (
            isinstance(source, value_types.Vector) and not isinstance(target, value_types.Vector),
            "write an index, `[0]`",
        ),
        (
            isinstance(source, value_types.Record) and not isinstance(target, value_types.Record),
            "write a field, `.data`",
        ),
    )
    if isinstance(source, value_types.Void):
        return "this function has no value"
    hint = next((hint for fits, hint in hints if fits), "")
    return f"{source} cannot become {target}" + (f"; {hint}" if hint else "")


def number(value: nodes.Expression, target: Type) -> nodes.Expression:
    """A number as one of another type."""
    return value if value.type == target else nodes.Convert(target, value)


def condition(value: Value) -> nodes.Expression:
    """A value as a condition."""
    if not value_types.is_number(value.type):
        hint = (
            "; write `.empty()` or compare it"
            if isinstance(value.type, value_types.String | value_types.Vector)
            else ""
        )
        raise SpecificationError.at(value.position, f"{value.type} is no condition{hint}")
    return number(value.form, value_types.BOOL)


def constant_value(position: Position, kind: Type, constant: bool | int | float | bytes) -> Value:
    """A value that is known."""
    return Value(nodes.Literal(kind, constant), position, constant=constant)


def require_number(value: Value, what: str) -> None:
    """Refuse what is not a number."""
    if not value_types.is_number(value.type):
        raise SpecificationError.at(value.position, f"{what} needs a number; this is {value.type}")
