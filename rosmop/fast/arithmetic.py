"""Numbers, truths and times: what is calculated with them, as instructions."""

from math import inf

from rosmop.fast.abi import NOW
from rosmop.fast.function_parts import Parts
from rosmop.fast.memory_layout import NotScalarError, is_signed, machine_type
from rosmop.fast.wasm import (
    ABS,
    CALCULATE,
    COMPARE,
    ELSE,
    END,
    F32,
    F64,
    I32,
    I64,
    IF,
    NEG,
    SELECT,
    constant,
)
from rosmop.form import nodes
from rosmop.runtime import times
from rosmop.runtime.times import BILLION
from rosmop.types import value_types
from rosmop.types.value_types import Type


class Arithmetic(Parts):
    """Writes what has numbers, truths and times as its operands."""

    # Numbers

    def _literal(self, node: nodes.Literal) -> bytes:
        if not isinstance(node.value, int | float):
            raise NotScalarError(repr(node.value))
        return constant(machine_type(node.type), node.value)

    def _zero(self, node: nodes.Zero) -> bytes:
        return constant(machine_type(node.type), 0)

    def _now(self, _node: nodes.Now) -> bytes:
        return self._cell(0x29, NOW)

    def _convert(self, node: nodes.Convert) -> bytes:
        code, source, target = self._value(node.value), node.value.type, node.type
        one, other = machine_type(source), machine_type(target)
        if isinstance(target, value_types.Bool):
            return code + constant(one, 0) + bytes((COMPARE[one]["!="],))
        if isinstance(target, value_types.Floating):
            return code + to_floating(one, other, signed=is_signed(source))
        assert isinstance(target, value_types.Integer)  # noqa: S101  numbers are one of the three
        if isinstance(source, value_types.Floating):
            return self._truncated(code + (b"\xbb" if one == F32 else b""), target)
        if one == other:
            return code + _narrowed(target)
        if other == I64:
            return code + (b"\xac" if is_signed(source) else b"\xad")
        return code + b"\xa7" + _narrowed(target)

    def _truncated(self, code: bytes, target: value_types.Integer) -> bytes:
        """A double toward zero, at most the limits."""
        if target.bits >= 32:
            wide = 4 if target.bits == 64 else 0
            return code + b"\xfc" + bytes((2 + wide + (not target.signed),))
        code += b"\xfc\x02" + self._set("cut")
        for limit, operator in ((target.least, "<"), (target.most, ">")):
            limited, value = constant(I32, limit), self._get("cut")
            test = value + limited + bytes((COMPARE[I32][operator],))
            code += limited + value + test + SELECT + self._set("cut")
        return code + self._get("cut")

    def _arithmetic(self, node: nodes.Arithmetic) -> bytes:
        machine, operator = machine_type(node.type), node.operator
        left, right = self._value(node.left), self._value(node.right)
        opcode = CALCULATE[machine][operator]
        if machine in (F32, F64) or operator in "+-*&|^":
            return left + right + bytes((opcode,))
        unsigned = not is_signed(node.type)
        if operator in ("<<", ">>"):
            if machine_type(node.right.type) != machine:
                right += b"\xa7" if machine == I32 else b"\xad"
            return left + right + bytes((opcode + (unsigned and operator == ">>"),))
        return self._divided(node, left, right, bytes((opcode + unsigned,)))

    def _divided(self, node: nodes.Arithmetic, left: bytes, right: bytes, opcode: bytes) -> bytes:
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("dividend", "divisor"))
        code = left + self._set(one, machine) + right + self._set(other, machine)
        zero = self._get(other, machine) + (b"\x45" if machine == I32 else b"\x50")
        code += self._when(zero, self._elsewhere)
        quotient = self._get(one, machine) + self._get(other, machine) + opcode
        if node.operator == "%" or not is_signed(node.type):
            return code + quotient
        minus = self._get(other, machine) + constant(machine, -1) + bytes((COMPARE[machine]["=="],))
        negated = constant(machine, 0) + self._get(one, machine) + bytes((CALCULATE[machine]["-"],))
        return code + minus + IF + bytes((machine,)) + negated + ELSE + quotient + END

    def _unary(self, node: nodes.Unary) -> bytes:
        machine, value = machine_type(node.type), self._value(node.value)
        if machine in (F32, F64):
            return value + bytes(((ABS if node.operator == "abs" else NEG)[machine],))
        if node.operator == "~":
            return value + constant(machine, -1) + bytes((CALCULATE[machine]["^"],))
        kept = f"kept {machine}"
        code = value + self._set(kept, machine)
        negated = constant(machine, 0) + self._get(kept, machine) + bytes((CALCULATE[machine]["-"],))
        if node.operator == "-":
            return code + negated
        if not is_signed(node.type):
            return code + self._get(kept, machine)
        negative = self._get(kept, machine) + constant(machine, 0) + bytes((COMPARE[machine]["<"],))
        return code + negated + self._get(kept, machine) + negative + SELECT

    def _compare(self, node: nodes.Compare) -> bytes:
        machine = machine_type(node.left.type)
        opcode = COMPARE[machine][node.operator]
        if node.operator not in ("==", "!=") and not is_signed(node.left.type):
            opcode += 1
        return self._value(node.left) + self._value(node.right) + bytes((opcode,))

    def _logical(self, node: nodes.Logical) -> bytes:
        yes, no = self._nested(node.right), constant(I32, node.operator == "or")
        branches = (yes, no) if node.operator == "and" else (no, yes)
        return self._value(node.left) + IF + bytes((I32,)) + branches[0] + ELSE + branches[1] + END

    def _nested(self, node: nodes.Expression) -> bytes:
        self._depth += 1
        code = self._value(node)
        self._depth -= 1
        return code

    def _not(self, node: nodes.Not) -> bytes:
        return self._value(node.value) + b"\x45"

    def _conditional(self, node: nodes.Conditional) -> bytes:
        kind = bytes((machine_type(node.type),))
        yes, no = self._nested(node.yes), self._nested(node.no)
        return self._value(node.test) + IF + kind + yes + ELSE + no + END

    def _question(self, argument: nodes.Expression, operator: str) -> bytes:
        """Compare the size of a number with infinity."""
        machine = machine_type(argument.type)
        if machine not in (F32, F64):
            raise NotScalarError(str(argument.type))
        size = self._value(argument) + bytes((ABS[machine],))
        compared = size + constant(machine, inf) + bytes((COMPARE[machine][operator.strip("!")],))
        return compared + (b"\x45" if operator.startswith("!") else b"")

    def _least(self, node: nodes.Call) -> bytes:
        """`std::min` and `std::max`: the second if it is less, or greater; `fmin` and `fmax`: or the first is NaN."""
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("first", "second"))
        code = b"".join(
            self._value(argument) + self._set(name, machine)
            for name, argument in zip((one, other), node.arguments, strict=True)
        )
        opcode = COMPARE[machine]["<" if "min" in node.function else ">"] + (not is_signed(node.type))
        test = self._get(other, machine) + self._get(one, machine) + bytes((opcode,))
        if node.function not in ("h_min", "h_max"):
            none = self._get(one, machine) + self._get(one, machine) + bytes((COMPARE[machine]["!="],))
            test += none + b"\x72"
        return code + self._get(other, machine) + self._get(one, machine) + test + SELECT

    # Times and durations, which are nanoseconds in 64 bits

    def _moment(self, node: nodes.Moment) -> bytes:
        both = self._value(node.left) + self._value(node.right)
        return self._limited(node.type, both + bytes((CALCULATE[I64][node.operator],)))

    def _moment_of(self, node: nodes.MomentOf) -> bytes:
        return self._limited(
            node.type, self._of_parts(self._value(node.seconds), self._value(node.nanoseconds))
        )

    def _of_parts(self, seconds: bytes, nanoseconds: bytes) -> bytes:
        """Nanoseconds of two numbers in 64 bits; elsewhere if they are so large that this would not be exact."""
        code, names = b"", [f"{part} {len(self._locals)}" for part in ("seconds", "nanoseconds")]
        for name, value, most in zip(names, (seconds, nanoseconds), (1 << 32, 1 << 61), strict=True):
            code += value + self._set(name, I64)
            wide = self._get(name, I64) + constant(I64, most) + b"\x7c" + constant(I64, 2 * most) + b"\x56"
            code += self._when(wide, self._elsewhere)
        return (
            code
            + self._get(names[0], I64)
            + constant(I64, BILLION)
            + b"\x7e"
            + self._get(names[1], I64)
            + b"\x7c"
        )

    def _limited(self, kind: Type, code: bytes) -> bytes:
        """A time or duration, elsewhere if it is none."""
        least, most = (
            (0, times.MAX_TIME) if kind == value_types.TIME else (times.MIN_DURATION, times.MAX_DURATION)
        )
        name = f"moment {len(self._locals)}"
        code += self._set(name, I64)
        for limit, opcode in ((least, b"\x53"), (most, b"\x55")):
            code += self._when(self._get(name, I64) + constant(I64, limit) + opcode, self._elsewhere)
        return code + self._get(name, I64)

    def _with_part(self, node: nodes.Call) -> bytes:
        """A time with other seconds, or other nanoseconds."""
        moment, part, new = node.arguments
        assert isinstance(part, nodes.Literal)  # noqa: S101  the name of a part
        value = self._value(new)
        if machine_type(new.type) == I32:
            value += b"\xac" if is_signed(new.type) else b"\xad"
        old = self._value(moment)
        if part.value == b"sec":
            return self._limited(node.type, self._of_parts(value, old + self._nanoseconds()))
        return self._limited(node.type, self._of_parts(old + self._seconds(), value))

    def _nanoseconds(self) -> bytes:
        """The part of a moment: not less than nothing."""
        code, value = self._set("moment", I64), self._get("moment", I64)
        whole = self._get("whole", I64)
        code += value + constant(I64, BILLION) + b"\x81" + self._set("whole", I64)
        more = whole + constant(I64, BILLION) + b"\x7c" + self._set("whole", I64)
        return code + self._when(whole + constant(I64, 0) + b"\x53", lambda: more) + whole

    def _seconds(self) -> bytes:
        rest = self._nanoseconds() + self._set("rest", I64)
        return (
            rest
            + self._get("moment", I64)
            + self._get("rest", I64)
            + b"\x7d"
            + constant(I64, BILLION)
            + b"\x7f"
        )

    def _in_seconds(self) -> bytes:
        """A moment as a double, rounded once: what has more than 53 bits is divided by 5^9 with 40 bits behind the
        point, the last of which says whether something is left, and then by 2^9.
        """
        code, value = self._set("moment", I64), self._get("moment", I64)
        size = self._get("whole", I64)
        negative = value + constant(I64, 0) + b"\x53"
        code += constant(I64, 0) + value + b"\x7d" + value + negative + SELECT + self._set("whole", I64)
        short = size + b"\xb9" + constant(F64, 1e9) + b"\xa3"
        over = constant(I64, 5**9)
        rest = size + over + b"\x82" + constant(I64, 40) + b"\x86" + self._set("rest", I64)
        left = self._get("rest", I64) + over + b"\x82\x50\x45\xad"
        behind = (
            self._get("rest", I64) + over + b"\x80" + left + b"\x84\xb9" + constant(F64, 2.0**-40) + b"\xa2"
        )
        long = rest + size + over + b"\x80\xb9" + behind + b"\xa0" + constant(F64, 2.0**-9) + b"\xa2"
        code += size + constant(I64, 1 << 53) + b"\x54" + IF + bytes((F64,)) + short + ELSE + long + END
        code += self._set("in seconds", F64)
        result = self._get("in seconds", F64)
        return code + result + bytes((NEG[F64],)) + result + negative + SELECT

    def _parts_of(self, kind: Type, moment: bytes) -> tuple[bytes, bytes]:
        """What divides nanoseconds into seconds and the rest; the two as they stand."""
        code = self._limited(kind, moment) + self._seconds() + self._set("whole", I64)
        low = self._get("whole", I64) + constant(I64, 0xFFFFFFFF) + b"\x83"
        return code, low + self._get("rest", I64) + constant(I64, 32) + b"\x86\x84"


def to_floating(source: int, target: int, *, signed: bool) -> bytes:
    """A number as a floating-point number."""
    if source in (F32, F64):
        return b"" if source == target else b"\xb6" if target == F32 else b"\xbb"
    first = 0xB2 if target == F32 else 0xB7
    return bytes((first + 2 * (source == I64) + (not signed),))


def _narrowed(target: value_types.Integer) -> bytes:
    """Wrap what stands in 32 bits into fewer."""
    if target.bits >= 32:
        return b""
    if target.signed:
        return b"\xc0" if target.bits == 8 else b"\xc1"
    return constant(I32, target.most) + b"\x71"
