"""Compile operators, with the types that C++ gives their results."""

from rosmop.check import cursors, order
from rosmop.check.assignables import Value
from rosmop.check.conversion import condition, convert, number
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.types import value_types
from rosmop.types.value_types import Type

COMPARISONS = frozenset({"==", "!=", "<", ">", "<=", ">="})
_BITS = frozenset({"&", "|", "^"})
_TEXTS = (value_types.StringType, value_types.CharactersType)
_MOMENTS = (value_types.TimeType, value_types.DurationType)


class Operands:
    """Two operands, with the position and the site of the operation."""

    def __init__(
        self, scope: FunctionScope, position: Position, left: Value, right: Value, site: int
    ) -> None:
        self.scope = scope
        self.position = position
        self.left = left
        self.right = right
        self.site = site

    def value(self, result: nodes.Expression) -> Value:
        return Value(result, self.position)

    def type_error(self, operator: str, hint: str = "") -> SpecificationError:
        left, right = self.left.type, self.right.type
        return SpecificationError.at(
            self.position, f"`{operator}` has no meaning for {left} and {right}{hint}"
        )


def binary(operator: str, operands: Operands) -> Value:
    left, right = operands.left.type, operands.right.type
    if operator in ("&&", "||"):
        word = "and" if operator == "&&" else "or"
        return operands.value(nodes.Logical(word, condition(operands.left), condition(operands.right)))
    if value_types.is_number(left) and value_types.is_number(right):
        return _comparison(operator, operands) if operator in COMPARISONS else _arithmetic(operator, operands)
    if isinstance(left, _TEXTS) or isinstance(right, _TEXTS):
        return _texts(operator, operands)
    if isinstance(left, _MOMENTS) or isinstance(right, _MOMENTS):
        return _moments(operator, operands)
    cursor = cursors.move(operator, operands.left, operands.right, operands.position)
    if cursor is not None:
        return cursor
    if (
        operator in ("==", "!=")
        and left == right
        and not isinstance(left, value_types.VoidType | value_types.IteratorType)
    ):
        first, (one, other) = order.arguments(operands.scope, (operands.left, operands.right))
        return order.after(
            first, operands.value(nodes.Compare(operator, one.form, other.form, operands.site))
        )
    raise operands.type_error(operator, _hint(left, right))


def _hint(left: Type, right: Type) -> str:
    if isinstance(left, value_types.VectorType) != isinstance(right, value_types.VectorType):
        return "; write an index, `[0]`"
    if isinstance(left, value_types.RecordType) or isinstance(right, value_types.RecordType):
        return "; write a field, `.data`"
    return ""


def _comparison(operator: str, operands: Operands) -> Value:
    kind = value_types.common(operands.left.type, operands.right.type)
    left, right = (number(value.form, kind) for value in (operands.left, operands.right))
    return operands.value(nodes.Compare(operator, left, right, operands.site))


def _arithmetic(operator: str, operands: Operands) -> Value:
    if operator in ("<<", ">>"):
        return _shift(operator, operands)
    kind = value_types.common(operands.left.type, operands.right.type)
    if isinstance(kind, value_types.FloatingType) and (operator == "%" or operator in _BITS):
        raise operands.type_error(operator, "; write `fmod(…)`" if operator == "%" else "")
    left, right = (number(value.form, kind) for value in (operands.left, operands.right))
    return operands.value(nodes.Arithmetic(kind, operator, left, right, operands.site))


def _shift(operator: str, operands: Operands) -> Value:
    kind, amount = value_types.promote(operands.left.type), value_types.promote(operands.right.type)
    if not isinstance(kind, value_types.IntegerType) or not isinstance(amount, value_types.IntegerType):
        raise operands.type_error(operator)
    left = number(operands.left.form, kind)
    return operands.value(nodes.Arithmetic(kind, operator, left, operands.right.form, operands.site))


def _texts(operator: str, operands: Operands) -> Value:
    left, right = operands.left, operands.right
    if operator == "+":
        return _put_together("o_join", operands)
    if operator == "<<":
        raise operands.type_error(operator, "; write `std::cout << …` or ROS_INFO_STREAM(…)")
    if operator not in COMPARISONS:
        raise operands.type_error(operator)
    if not (isinstance(left.type, _TEXTS) and isinstance(right.type, _TEXTS)):
        raise operands.type_error(operator, _text_hint(left, right))
    one, other = (convert(operands.scope, value, value_types.STRING) for value in (left, right))
    short = any(
        isinstance(value.constant, bytes) and len(value.constant) <= nodes.SHORT for value in (left, right)
    )
    return operands.value(nodes.CompareTexts(operator, one, other, short, operands.site))


def extend(operands: Operands) -> Value:
    return _put_together("o_extend", operands)


def _put_together(function: str, operands: Operands) -> Value:
    for value, other in ((operands.left, operands.right), (operands.right, operands.left)):
        if isinstance(value.type, value_types.CharactersType) and isinstance(
            other.type, value_types.IntegerType | value_types.FloatingType
        ):
            hint = "; there is no pointer arithmetic: write `std::string(…).substr(1)`"
            raise operands.type_error("+", hint)
    texts = (_join(operands, operands.left), _join(operands, operands.right))
    return operands.value(nodes.Call(value_types.STRING, function, texts, operands.site))


def _text_hint(left: Value, right: Value) -> str:
    other = left if isinstance(right.type, _TEXTS) else right
    if other.type == value_types.CHAR:
        return "; a character is written 'a', a string \"a\""
    return "; write an index, `[0]`" if isinstance(other.type, value_types.VectorType) else ""


def _join(operands: Operands, value: Value) -> nodes.Expression:
    if isinstance(value.type, value_types.IntegerType) and value.type == value_types.CHAR:
        return nodes.Call(value_types.STRING, "t_byte", (value.form,))
    if value_types.is_number(value.type):
        raise SpecificationError.at(
            value.position, f"{value.type} is not a string; write `std::to_string(…)`"
        )
    return convert(operands.scope, value, value_types.STRING)


def _moments(operator: str, operands: Operands) -> Value:
    left, right, site = operands.left, operands.right, operands.site
    if operator in COMPARISONS and left.type == right.type:
        return operands.value(nodes.Compare(operator, left.form, right.form, site))
    if operator in ("+", "-"):
        kind = _sum(operator, left.type, right.type)
        if kind is not None:
            return operands.value(nodes.Moment(kind, operator, left.form, right.form, site))
    if operator == "*" and left.type == value_types.DURATION and value_types.is_number(right.type):
        return operands.value(nodes.Call(value_types.DURATION, "o_scaled", (left.form, right.form), site))
    raise operands.type_error(operator, "; write `.toSec()` to calculate in seconds")


def _sum(operator: str, left: Type, right: Type) -> Type | None:
    if left == value_types.TIME and right == value_types.TIME and operator == "-":
        return value_types.DURATION
    if left == value_types.TIME and right == value_types.DURATION:
        return value_types.TIME
    return value_types.DURATION if left == right == value_types.DURATION else None


def unary(operator: str, operand: Value, position: Position, site: int) -> Value:
    if operator == "!":
        return Value(nodes.Not(condition(operand)), position)
    if operator == "-" and operand.type == value_types.DURATION:
        nothing = nodes.Literal(value_types.DURATION, 0)
        return Value(nodes.Moment(value_types.DURATION, "-", nothing, operand.form, site), position)
    kind = value_types.promote(operand.type)
    if not value_types.is_number(kind) or (operator == "~" and not isinstance(kind, value_types.IntegerType)):
        raise SpecificationError.at(position, f"`{operator}` has no meaning for {operand.type}")
    value = number(operand.form, kind)
    changed = value if operator == "+" else nodes.Unary(kind, operator, value)
    return Value(changed, position)
