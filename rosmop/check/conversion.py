"""Conversions between types: a value as C++ assigns it to a variable of another type."""

from rosmop.check.assignables import Value
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.types import value_types
from rosmop.types.value_types import Type


def convert(scope: FunctionScope, value: Value, target: Type, site: int | None = None) -> nodes.Expression:
    """Return the value in another type, copied if anything else refers to it."""
    check_convertible(value, target)
    if value_types.is_number(target):
        return number(value.form, target)
    where = scope.lines.site if site is None else site
    if isinstance(target, value_types.StringType) and isinstance(value.type, value_types.CharactersType):
        return nodes.Call(target, "c_terminated", (value.form,), where)
    if isinstance(target, value_types.CharactersType) and isinstance(value.type, value_types.StringType):
        return nodes.Call(target, "t_zeroed", (value.form,), where)
    if (
        isinstance(value.type, value_types.VectorType)
        and isinstance(target, value_types.VectorType)
        and value.type.element != target.element
    ):
        return nodes.Recast(target, value.form, where)
    if value.owned or value_types.is_scalar(value.type):
        return value.form
    return nodes.Copy(value.type, value.form, where)


def check_convertible(value: Value, target: Type) -> None:
    if not value_types.convertible(value.type, target):
        raise SpecificationError.at(value.position, refusal(value.type, target))


def refusal(source: Type, target: Type) -> str:
    text, moment = (
        (value_types.StringType, value_types.CharactersType),
        (value_types.TimeType, value_types.DurationType),
    )
    hints = (
        (isinstance(target, text) and value_types.is_number(source), "write `std::to_string(…)`"),
        (
            value_types.is_number(target) and isinstance(source, text),
            "write `std::stod(…)` or `std::stoi(…)`",
        ),
        (value_types.is_number(target) and isinstance(source, moment), "write `.toSec()`, `.sec` or `.nsec`"),
        (isinstance(target, moment) and value_types.is_number(source), f"write `{target}(…)`"),
        (
            isinstance(source, value_types.VectorType) and not isinstance(target, value_types.VectorType),
            "write an index, `[0]`",
        ),
        (
            isinstance(source, value_types.RecordType) and not isinstance(target, value_types.RecordType),
            "write a field, `.data`",
        ),
    )
    if isinstance(source, value_types.VoidType):
        return "this function returns no value"
    hint = next((hint for fits, hint in hints if fits), "")
    return f"{source} cannot become {target}" + (f"; {hint}" if hint else "")


def number(value: nodes.Expression, target: Type) -> nodes.Expression:
    return value if value.type == target else nodes.Convert(target, value)


def condition(value: Value) -> nodes.Expression:
    if not value_types.is_number(value.type):
        hint = (
            "; write `.empty()` or compare it"
            if isinstance(value.type, value_types.StringType | value_types.VectorType)
            else ""
        )
        raise SpecificationError.at(value.position, f"{value.type} is not a condition{hint}")
    return number(value.form, value_types.BOOL)


def constant_value(position: Position, kind: Type, constant: bool | int | float | bytes) -> Value:
    return Value(nodes.Literal(kind, constant), position, constant=constant)


def require_number(value: Value, what: str) -> None:
    if not value_types.is_number(value.type):
        raise SpecificationError.at(value.position, f"{what} needs a number; this is {value.type}")
