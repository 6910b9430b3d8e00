"""Operators as code, with the types C++ gives their results."""

from appliance.rosmop.compile import cursors
from appliance.rosmop.compile.conversion import (
    condition,
    convert,
    number,
    wrapped,
)
from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import numbers, texts, times, vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

FUNCTIONS = {
    "o_divide": numbers.divide,
    "o_remainder": numbers.remainder,
    "o_ratio": numbers.ratio,
    "o_join": texts.join,
    "o_extend": texts.extend,
    "o_time": times.time,
    "o_duration": times.duration,
    "o_scaled": times.scaled,
    "o_bytes": bytes,
    "o_charged": texts.charged,
    "o_weighed": vectors.weighed,
}
COMPARISONS = frozenset({"==", "!=", "<", ">", "<=", ">="})
_SHORT = 64  # bytes; to compare with a string of so many takes no longer than any other instruction
_BITS = frozenset({"&", "|", "^"})
_TEXTS = (kinds.String, kinds.Characters)
_MOMENTS = (kinds.Time, kinds.Duration)


class Operands:
    """Two operands, where the operation stands, and the site of its faults."""

    def __init__(self, scope: Scope, position: Position, left: Value, right: Value, site: int) -> None:
        self.scope = scope
        self.position = position
        self.left = left
        self.right = right
        self.site = site

    def value(self, kind: Type, code: str) -> Value:
        """The result."""
        return Value(kind, code, self.position, pure=self.left.pure and self.right.pure)

    def refused(self, operator: str, hint: str = "") -> SpecificationError:
        """The refusal of this operation."""
        left, right = self.left.type, self.right.type
        return SpecificationError.at(
            self.position, f"`{operator}` has no meaning for {left} and {right}{hint}"
        )


def binary(operator: str, operands: Operands) -> Value:
    """`left operator right`."""
    left, right = operands.left.type, operands.right.type
    if operator in ("&&", "||"):
        word = "and" if operator == "&&" else "or"
        code = f"({condition(operands.left)} {word} {condition(operands.right)})"
        return operands.value(kinds.BOOL, code)
    if kinds.is_number(left) and kinds.is_number(right):
        return _comparison(operator, operands) if operator in COMPARISONS else _arithmetic(operator, operands)
    if isinstance(left, _TEXTS) or isinstance(right, _TEXTS):
        return _texts(operator, operands)
    if isinstance(left, _MOMENTS) or isinstance(right, _MOMENTS):
        return _moments(operator, operands)
    cursor = cursors.moved(operator, operands.left, operands.right, operands.position)
    if cursor is not None:
        return cursor
    if operator in ("==", "!=") and left == right and not isinstance(left, kinds.Void | cursors.Cursor):
        return operands.value(kinds.BOOL, f"({_weighed(operands, left)} {operator} {operands.right.code})")
    raise operands.refused(operator, _hint(left, right))


def _weighed(operands: Operands, kind: Type) -> str:
    """The left operand; a vector or message is charged by what it holds."""
    code, scope = operands.left.code, operands.scope
    if not isinstance(kind, kinds.Vector | kinds.Record):
        return code
    measure = scope.module.use(scope.codecs.measure(kind))
    return f"o_weighed({scope.context}, {code}, {measure}, {operands.site})"


def _hint(left: Type, right: Type) -> str:
    if isinstance(left, kinds.Vector) != isinstance(right, kinds.Vector):
        return "; write an index, `[0]`"
    if isinstance(left, kinds.Record) or isinstance(right, kinds.Record):
        return "; write a field, `.data`"
    return ""


def _comparison(operator: str, operands: Operands) -> Value:
    kind = kinds.common(operands.left.type, operands.right.type)
    left, right = (_compared(value, kind) for value in (operands.left, operands.right))
    return operands.value(kinds.BOOL, f"({left} {operator} {right})")


def _compared(value: Value, kind: Type) -> str:
    """An operand of a comparison; Python compares integers and doubles with each other exactly where it is safe."""
    small = isinstance(value.type, kinds.Bool) or (
        isinstance(value.type, kinds.Integer) and value.type.bits <= 32
    )
    if isinstance(kind, kinds.Floating) and kind.bits == 64 and small:
        return value.code
    return number(value.code, value.type, kind)


def _arithmetic(operator: str, operands: Operands) -> Value:
    if operator in ("<<", ">>"):
        return _shift(operator, operands)
    kind = kinds.common(operands.left.type, operands.right.type)
    left = number(operands.left.code, operands.left.type, kind)
    right = number(operands.right.code, operands.right.type, kind)
    if isinstance(kind, kinds.Floating):
        if kind.bits == 64 and isinstance(operands.right.type, kinds.Floating):
            left = _mixed(operands.left, left)
        elif kind.bits == 64:
            right = _mixed(operands.right, right)
        return operands.value(kind, _floating(operator, operands, left, right, kind))
    assert isinstance(kind, kinds.Integer)  # the common type of two numbers
    if operator in ("/", "%"):
        return operands.value(kind, _division(operator, operands, left, right, kind))
    code = (
        f"({left} {operator} {right})" if operator in _BITS else wrapped(f"{left} {operator} {right}", kind)
    )
    return operands.value(kind, code)


def _division(operator: str, operands: Operands, left: str, right: str, kind: kinds.Integer) -> str:
    divisor = operands.right.constant
    if not kind.signed and isinstance(divisor, int) and divisor > 0:
        return f"({left} {'//' if operator == '/' else '%'} {right})"  # of what is not negative: as Python's
    if operator == "/":
        return wrapped(f"o_divide({left}, {right}, {operands.site})", kind)
    return f"o_remainder({left}, {right}, {operands.site})"


def _mixed(value: Value, converted: str) -> str:
    """An operand beside a double: Python converts an integer as C++ does."""
    return value.code if isinstance(value.type, kinds.Integer) else converted


def _floating(operator: str, operands: Operands, left: str, right: str, kind: kinds.Floating) -> str:
    if operator == "%" or operator in _BITS:
        raise operands.refused(operator, "; write `fmod(…)`" if operator == "%" else "")
    if operator == "/":
        safe = isinstance(operands.right.constant, int | float) and operands.right.constant != 0
        code = f"({left} / {right})" if safe else f"o_ratio({left}, {right})"
    else:
        code = f"({left} {operator} {right})"
    return f"c_f32({code})" if kind.bits == 32 else code


def _shift(operator: str, operands: Operands) -> Value:
    kind, amount = kinds.promoted(operands.left.type), kinds.promoted(operands.right.type)
    if not isinstance(kind, kinds.Integer) or not isinstance(amount, kinds.Integer):
        raise operands.refused(operator)
    left = number(operands.left.code, operands.left.type, kind)
    shifted = f"{left} {operator} ({operands.right.code} & {kind.bits - 1})"
    return operands.value(kind, wrapped(f"({shifted})", kind) if operator == "<<" else f"({shifted})")


def _texts(operator: str, operands: Operands) -> Value:
    left, right = operands.left, operands.right
    if operator == "+":
        return _put_together("o_join", operands)
    if operator == "<<":
        raise operands.refused(operator, "; write `std::cout << …` or ROS_INFO_STREAM(…)")
    if operator not in COMPARISONS:
        raise operands.refused(operator)
    if not (isinstance(left.type, _TEXTS) and isinstance(right.type, _TEXTS)):
        raise operands.refused(operator, _text_hint(left, right))
    codes = [convert(operands.scope, value, kinds.STRING) for value in (left, right)]
    return operands.value(kinds.BOOL, _compared_texts(operands, operator, codes[0], codes[1]))


def _compared_texts(operands: Operands, operator: str, left: str, right: str) -> str:
    """Two strings are charged by their length, unless one is short; most are."""
    if any(
        isinstance(value.constant, bytes) and len(value.constant) <= _SHORT
        for value in (operands.left, operands.right)
    ):
        return f"({left} {operator} {right})"
    charged = f"o_charged({operands.scope.context}, {left}, {operands.site}) {operator} {right}"
    known = next((code for code in (right, left) if code.isidentifier()), None)
    if known is None:
        return f"({charged})"
    return f"({left} {operator} {right} if l_len({known}) <= {_SHORT} else {charged})"


def extended(operands: Operands) -> Value:
    """`left += right`, where `left` is a string: what it holds goes with it."""
    return _put_together("o_extend", operands)


def _put_together(function: str, operands: Operands) -> Value:
    for value, other in ((operands.left, operands.right), (operands.right, operands.left)):
        if isinstance(value.type, kinds.Characters) and isinstance(
            other.type, kinds.Integer | kinds.Floating
        ):
            hint = "; there is no arithmetic of pointers: write `std::string(…).substr(1)`"
            raise operands.refused("+", hint)
    codes = [_joined(operands, value) for value in (operands.left, operands.right)]
    code = f"{function}({operands.scope.context}, {codes[0]}, {codes[1]}, {operands.site})"
    return operands.value(kinds.STRING, code)


def _text_hint(left: Value, right: Value) -> str:
    other = left if isinstance(right.type, _TEXTS) else right
    if other.type == kinds.CHAR:
        return "; a character is written 'a', a string \"a\""
    return "; write an index, `[0]`" if isinstance(other.type, kinds.Vector) else ""


def _joined(operands: Operands, value: Value) -> str:
    if isinstance(value.type, kinds.Integer) and value.type == kinds.CHAR:
        return f"o_bytes(({value.code} & 255,))"
    if kinds.is_number(value.type):
        raise SpecificationError.at(value.position, f"{value.type} is no string; write `std::to_string(…)`")
    return convert(operands.scope, value, kinds.STRING)


def _moments(operator: str, operands: Operands) -> Value:
    left, right = operands.left.type, operands.right.type
    if operator in COMPARISONS and left == right:
        return operands.value(kinds.BOOL, f"({operands.left.code} {operator} {operands.right.code})")
    if operator in ("+", "-"):
        kind = _sum(operator, left, right)
        if kind is not None:
            function = "o_time" if kind == kinds.TIME else "o_duration"
            code = f"{function}({operands.left.code} {operator} {operands.right.code}, {operands.site})"
            return operands.value(kind, code)
    if operator == "*" and left == kinds.DURATION and kinds.is_number(right):
        return operands.value(
            kinds.DURATION, f"o_scaled({operands.left.code}, {operands.right.code}, {operands.site})"
        )
    raise operands.refused(operator, "; write `.toSec()` to calculate in seconds")


def _sum(operator: str, left: Type, right: Type) -> Type | None:
    if left == kinds.TIME and right == kinds.TIME and operator == "-":
        return kinds.DURATION
    if left == kinds.TIME and right == kinds.DURATION:
        return kinds.TIME
    return kinds.DURATION if left == right == kinds.DURATION else None


def unary(operator: str, operand: Value, position: Position, site: int) -> Value:
    """`!x`, `-x`, `+x`, `~x`."""
    if operator == "!":
        return Value(kinds.BOOL, f"(not {condition(operand)})", position, pure=operand.pure)
    if operator == "-" and operand.type == kinds.DURATION:
        return Value(operand.type, f"o_duration(-{operand.code}, {site})", position, pure=operand.pure)
    kind = kinds.promoted(operand.type)
    if not kinds.is_number(kind) or (operator == "~" and not isinstance(kind, kinds.Integer)):
        raise SpecificationError.at(position, f"`{operator}` has no meaning for {operand.type}")
    code = number(operand.code, operand.type, kind)
    changed = f"({operator}{code})" if operator != "+" else code
    if isinstance(kind, kinds.Integer) and operator != "+":
        changed = wrapped(changed, kind)
    return Value(kind, changed, position, pure=operand.pure)
