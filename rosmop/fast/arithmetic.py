"""Generate code for numbers, booleans and times."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from math import inf

from rosmop.fast.abi import ALTERED, NOW
from rosmop.fast.memory_layout import MemoryLayout, NotCompiledError, is_signed, machine_type
from rosmop.fast.wasm import (
    BLOCK,
    ELSE,
    END,
    F32,
    F32_ABS,
    F32_CONVERT_I32_S,
    F32_CONVERT_I32_U,
    F32_CONVERT_I64_S,
    F32_CONVERT_I64_U,
    F32_DEMOTE_F64,
    F32_NEG,
    F64,
    F64_ABS,
    F64_ADD,
    F64_CONVERT_I32_S,
    F64_CONVERT_I32_U,
    F64_CONVERT_I64_S,
    F64_CONVERT_I64_U,
    F64_DIV,
    F64_MUL,
    F64_NEG,
    F64_PROMOTE_F32,
    I32,
    I32_AND,
    I32_EQZ,
    I32_EXTEND8_S,
    I32_EXTEND16_S,
    I32_OR,
    I32_TRUNC_SAT_F64_S,
    I32_TRUNC_SAT_F64_U,
    I32_WRAP_I64,
    I64,
    I64_ADD,
    I64_AND,
    I64_DIV_S,
    I64_DIV_U,
    I64_EQZ,
    I64_EXTEND_I32_S,
    I64_EXTEND_I32_U,
    I64_GT_S,
    I64_GT_U,
    I64_LT_S,
    I64_LT_U,
    I64_MUL,
    I64_OR,
    I64_REM_S,
    I64_REM_U,
    I64_SHL,
    I64_SUB,
    I64_TRUNC_SAT_F64_S,
    I64_TRUNC_SAT_F64_U,
    IF,
    LOOP,
    NOTHING,
    RETURN,
    SELECT,
    UNREACHABLE,
    br,
    br_if,
    calculate,
    compare,
    constant,
    function,
    if_result,
    load,
    local_get,
    local_set,
    store,
)
from rosmop.form import nodes
from rosmop.runtime import times
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, UNMEASURED
from rosmop.runtime.times import BILLION
from rosmop.types import value_types
from rosmop.types.value_types import Type

# Write the parts that all functions have: local variables, branches, loops, charges.

ELSEWHERE = 8


class FunctionBuilder(ABC):
    """Writes a function, such as an event or handler (`answers`); its steps are charged to the budget `context`."""

    def __init__(
        self, layout: MemoryLayout, parameters: Mapping[str, int], context: str, *, answers: bool
    ) -> None:
        self._layout = layout
        self._context = context
        self._answers = answers
        self._locals = {name: (index, kind) for index, (name, kind) in enumerate(parameters.items())}
        self._depth = 0  # the number of open blocks
        self._loops: list[int] = []  # the depth of each loop's block
        self._assigned: set[str] = set()  # variables of the set, and local vectors and messages
        self._brief = True

    @abstractmethod
    def _block(self, statements: Sequence[nodes.Statement]) -> bytes: ...

    @abstractmethod
    def _value(self, node: nodes.Expression) -> bytes:
        """Push the value. Raises `NotCompiledError` unless it is a number."""

    @abstractmethod
    def _routine(
        self, parameters: tuple[int, ...], write: Callable[..., bytes], *given: object, result: int = I32
    ) -> bytes:
        """Call a function with parameters of these types. `write` writes it from the arguments `given`."""

    def _local(self, name: str, machine: int) -> int:
        number, known = self._locals.setdefault(name, (len(self._locals), machine))
        if known != machine:
            raise NotCompiledError("gives a variable values of two types")
        return number

    def _get(self, name: str, machine: int = I32) -> bytes:
        return local_get(self._local(name, machine))

    def _set(self, name: str, machine: int = I32) -> bytes:
        return local_set(self._local(name, machine))

    def _when(self, test: bytes, yes: Callable[[], bytes], no: Callable[[], bytes] | None = None) -> bytes:
        self._depth += 1
        inner = yes() + (ELSE + no() if no is not None else b"")
        self._depth -= 1
        return test + IF + NOTHING + inner + END

    def _elsewhere(self) -> bytes:
        return constant(I32, ELSEWHERE) + RETURN if self._answers else UNREACHABLE

    def _spend(self, instructions: bytes) -> bytes:
        budget = self._layout.budget(self._context)
        left = store(I64, budget, load(I64, budget) + instructions + I64_SUB)
        return left + self._when(load(I64, budget) + constant(I64, 0) + I64_LT_S, self._elsewhere)

    def _allocated(self, size: bytes) -> bytes:
        """Charge for the bytes (i64) of a new value.

        Leave the message to the interpreter if the specification's memory must be measured.
        """
        many = size + constant(I64, UNMEASURED) + I64_GT_U
        spent = size + constant(I64, BYTES_PER_INSTRUCTION) + I64_DIV_U
        return self._when(many, self._elsewhere) + self._spend(spent)

    def _times(self, left: str, each: bytes, body: Sequence[nodes.Statement] = ()) -> bytes:
        over = self._get(left, I64) + I64_EQZ + br_if(1)
        less = self._get(left, I64) + constant(I64, 1) + I64_SUB + self._set(left, I64)
        return self._repeat(over + less + each, body)

    def _repeat(self, before: bytes, body: Sequence[nodes.Statement]) -> bytes:
        self._depth += 2
        self._loops.append(self._depth)
        code = before + self._block(body)
        self._loops.pop()
        self._depth -= 2
        return BLOCK + LOOP + code + br(0) + END + END


_ABS, _NEG = {F32: F32_ABS, F64: F64_ABS}, {F32: F32_NEG, F64: F64_NEG}
_TRUNCATE = {
    (32, True): I32_TRUNC_SAT_F64_S, (32, False): I32_TRUNC_SAT_F64_U,
    (64, True): I64_TRUNC_SAT_F64_S, (64, False): I64_TRUNC_SAT_F64_U,
}  # fmt: skip
_CONVERT = {
    (F32, I32, True): F32_CONVERT_I32_S, (F32, I32, False): F32_CONVERT_I32_U,
    (F32, I64, True): F32_CONVERT_I64_S, (F32, I64, False): F32_CONVERT_I64_U,
    (F64, I32, True): F64_CONVERT_I32_S, (F64, I32, False): F64_CONVERT_I32_U,
    (F64, I64, True): F64_CONVERT_I64_S, (F64, I64, False): F64_CONVERT_I64_U,
}  # fmt: skip


class ArithmeticCodegen(FunctionBuilder):
    """Writes operations on numbers, booleans and times."""

    # Numbers

    def _literal(self, node: nodes.Literal) -> bytes:
        if not isinstance(node.value, int | float):
            raise NotCompiledError(f"uses the constant {node.value!r}")
        return constant(machine_type(node.type), node.value)

    def _zero(self, node: nodes.Zero) -> bytes:
        return constant(machine_type(node.type), 0)

    def _now(self, _node: nodes.Now) -> bytes:
        return load(I64, NOW)

    def _altered(self, _node: nodes.Altered) -> bytes:
        return load(I32, ALTERED) + constant(I32, 0) + compare(I32, "!=")

    def _convert(self, node: nodes.Convert) -> bytes:
        code, source, target = self._value(node.value), node.value.type, node.type
        one, other = machine_type(source), machine_type(target)
        if isinstance(target, value_types.BoolType):
            return code + constant(one, 0) + compare(one, "!=")
        if isinstance(target, value_types.FloatingType):
            return code + to_floating(one, other, signed=is_signed(source))
        assert isinstance(target, value_types.IntegerType)  # noqa: S101  a number has one of three types
        if isinstance(source, value_types.FloatingType):
            return self._truncate(code + (F64_PROMOTE_F32 if one == F32 else b""), target)
        if one == other:
            return code + _narrow(target)
        if other == I64:
            return code + (I64_EXTEND_I32_S if is_signed(source) else I64_EXTEND_I32_U)
        return code + I32_WRAP_I64 + _narrow(target)

    def _truncate(self, code: bytes, target: value_types.IntegerType) -> bytes:
        if target.bits >= 32:
            return code + _TRUNCATE[64 if target.bits == 64 else 32, target.signed]
        code += I32_TRUNC_SAT_F64_S + self._set("cut")
        for limit, operator in ((target.least, "<"), (target.most, ">")):
            limited, value = constant(I32, limit), self._get("cut")
            test = value + limited + compare(I32, operator)
            code += limited + value + test + SELECT + self._set("cut")
        return code + self._get("cut")

    def _arithmetic(self, node: nodes.Arithmetic) -> bytes:
        machine, operator = machine_type(node.type), node.operator
        left, right = self._value(node.left), self._value(node.right)
        if operator in ("<<", ">>") and machine_type(node.right.type) != machine:
            right += I32_WRAP_I64 if machine == I32 else I64_EXTEND_I32_U
        if operator in ("/", "%") and machine in (I32, I64):
            return self._divide(node, left, right)
        return left + right + calculate(machine, operator, signed=is_signed(node.type))

    def _divide(self, node: nodes.Arithmetic, left: bytes, right: bytes) -> bytes:
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("dividend", "divisor"))
        code = left + self._set(one, machine) + right + self._set(other, machine)
        zero = self._get(other, machine) + (I32_EQZ if machine == I32 else I64_EQZ)
        code += self._when(zero, self._elsewhere)
        quotient = self._get(one, machine) + self._get(other, machine)
        quotient += calculate(machine, node.operator, signed=is_signed(node.type))
        if node.operator == "%" or not is_signed(node.type):
            return code + quotient
        minus = self._get(other, machine) + constant(machine, -1) + compare(machine, "==")
        negated = constant(machine, 0) + self._get(one, machine) + calculate(machine, "-")
        return code + minus + if_result(machine) + negated + ELSE + quotient + END

    def _unary(self, node: nodes.Unary) -> bytes:
        machine, value = machine_type(node.type), self._value(node.value)
        if machine in (F32, F64):
            return value + (_ABS if node.operator == "abs" else _NEG)[machine]
        if node.operator == "~":
            return value + constant(machine, -1) + calculate(machine, "^")
        kept = f"kept {machine}"
        code = value + self._set(kept, machine)
        negated = constant(machine, 0) + self._get(kept, machine) + calculate(machine, "-")
        if node.operator == "-":
            return code + negated
        if not is_signed(node.type):
            return code + self._get(kept, machine)
        negative = self._get(kept, machine) + constant(machine, 0) + compare(machine, "<")
        return code + negated + self._get(kept, machine) + negative + SELECT

    def _compare(self, node: nodes.Compare) -> bytes:
        machine = machine_type(node.left.type)
        values = self._value(node.left) + self._value(node.right)
        return values + compare(machine, node.operator, signed=is_signed(node.left.type))

    def _logical(self, node: nodes.Logical) -> bytes:
        yes, no = self._nested(node.right), constant(I32, node.operator == "or")
        branches = (yes, no) if node.operator == "and" else (no, yes)
        return self._value(node.left) + if_result(I32) + branches[0] + ELSE + branches[1] + END

    def _nested(self, node: nodes.Expression) -> bytes:
        self._depth += 1
        code = self._value(node)
        self._depth -= 1
        return code

    def _not(self, node: nodes.Not) -> bytes:
        return self._value(node.value) + I32_EQZ

    def _conditional(self, node: nodes.Conditional) -> bytes:
        kind = machine_type(node.type)
        yes, no = self._nested(node.yes), self._nested(node.no)
        return self._value(node.test) + if_result(kind) + yes + ELSE + no + END

    def _question(self, argument: nodes.Expression, operator: str) -> bytes:
        machine = machine_type(argument.type)
        if machine not in (F32, F64):
            raise NotCompiledError.of(argument.type)
        size = self._value(argument) + _ABS[machine]
        compared = size + constant(machine, inf) + compare(machine, operator.strip("!"))
        return compared + (I32_EQZ if operator.startswith("!") else b"")

    def _least(self, node: nodes.Call) -> bytes:
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("first", "second"))
        code = b"".join(
            self._value(argument) + self._set(name, machine)
            for name, argument in zip((one, other), node.arguments, strict=True)
        )
        operator = "<" if "min" in node.function else ">"
        test = self._get(other, machine) + self._get(one, machine)
        test += compare(machine, operator, signed=is_signed(node.type))
        if node.function not in ("h_min", "h_max"):
            none = self._get(one, machine) + self._get(one, machine) + compare(machine, "!=")
            test += none + I32_OR
        return code + self._get(other, machine) + self._get(one, machine) + test + SELECT

    # Times and durations, which are nanoseconds in 64 bits

    def _moment(self, node: nodes.Moment) -> bytes:
        both = self._value(node.left) + self._value(node.right)
        return self._limit(node.type, both + calculate(I64, node.operator))

    def _moment_of(self, node: nodes.MomentOf) -> bytes:
        return self._limit(
            node.type, self._of_parts(self._value(node.seconds), self._value(node.nanoseconds))
        )

    def _of_parts(self, seconds: bytes, nanoseconds: bytes) -> bytes:
        code, names = b"", [f"{part} {len(self._locals)}" for part in ("seconds", "nanoseconds")]
        for name, value, most in zip(names, (seconds, nanoseconds), (1 << 32, 1 << 61), strict=True):
            code += value + self._set(name, I64)
            wide = self._get(name, I64) + constant(I64, most) + I64_ADD + constant(I64, 2 * most) + I64_GT_U
            code += self._when(wide, self._elsewhere)
        code += self._get(names[0], I64) + constant(I64, BILLION) + I64_MUL
        return code + self._get(names[1], I64) + I64_ADD

    def _limit(self, kind: Type, code: bytes) -> bytes:
        least, most = (
            (0, times.MAX_TIME) if kind == value_types.TIME else (times.MIN_DURATION, times.MAX_DURATION)
        )
        name = f"moment {len(self._locals)}"
        code += self._set(name, I64)
        for limit, opcode in ((least, I64_LT_S), (most, I64_GT_S)):
            code += self._when(self._get(name, I64) + constant(I64, limit) + opcode, self._elsewhere)
        return code + self._get(name, I64)

    def _with_part(self, node: nodes.Call) -> bytes:
        moment, part, new = node.arguments
        assert isinstance(part, nodes.Literal)  # noqa: S101  the name of a part
        value = self._value(new)
        if machine_type(new.type) == I32:
            value += I64_EXTEND_I32_S if is_signed(new.type) else I64_EXTEND_I32_U
        old = self._value(moment)
        if part.value == b"sec":
            return self._limit(node.type, self._of_parts(value, old + self._nanoseconds()))
        return self._limit(node.type, self._of_parts(old + self._seconds(), value))

    def _nanoseconds(self) -> bytes:
        code, value = self._set("moment", I64), self._get("moment", I64)
        whole = self._get("whole", I64)
        code += value + constant(I64, BILLION) + I64_REM_S + self._set("whole", I64)
        more = whole + constant(I64, BILLION) + I64_ADD + self._set("whole", I64)
        return code + self._when(whole + constant(I64, 0) + I64_LT_S, lambda: more) + whole

    def _seconds(self) -> bytes:
        rest = self._nanoseconds() + self._set("rest", I64)
        whole = self._get("moment", I64) + self._get("rest", I64) + I64_SUB
        return rest + whole + constant(I64, BILLION) + I64_DIV_S

    def _parts_of(self, kind: Type, moment: bytes) -> tuple[bytes, bytes]:
        code = self._limit(kind, moment) + self._seconds() + self._set("whole", I64)
        low = self._get("whole", I64) + constant(I64, 0xFFFFFFFF) + I64_AND
        return code, low + self._get("rest", I64) + constant(I64, 32) + I64_SHL + I64_OR


def in_seconds() -> bytes:
    """Write a function that converts a time to seconds as a double, rounded only once.

    A time of more than 53 bits is divided by 5^9 in fixed point, with 40 fractional bits, whose last bit is set if
    there is a remainder. The result is divided by 2^9.
    """
    moment, size, part, result = (local_get(local) for local in range(4))
    negative = moment + constant(I64, 0) + I64_LT_S
    code = constant(I64, 0) + moment + I64_SUB + moment + negative + SELECT + local_set(1)
    short = size + F64_CONVERT_I64_S + constant(F64, 1e9) + F64_DIV
    over = constant(I64, 5**9)
    rest = size + over + I64_REM_U + constant(I64, 40) + I64_SHL + local_set(2)
    left = part + over + I64_REM_U + I64_EQZ + I32_EQZ + I64_EXTEND_I32_U
    behind = part + over + I64_DIV_U + left + I64_OR + F64_CONVERT_I64_S
    behind += constant(F64, 2.0**-40) + F64_MUL
    long = rest + size + over + I64_DIV_U + F64_CONVERT_I64_S + behind + F64_ADD
    long += constant(F64, 2.0**-9) + F64_MUL
    code += (
        size + constant(I64, 1 << 53) + I64_LT_U + if_result(F64) + short + ELSE + long + END + local_set(3)
    )
    return function([(2, I64), (1, F64)], code + result + F64_NEG + result + negative + SELECT)


def to_floating(source: int, target: int, *, signed: bool) -> bytes:
    if source in (F32, F64):
        return b"" if source == target else F32_DEMOTE_F64 if target == F32 else F64_PROMOTE_F32
    return _CONVERT[target, source, signed]


def _narrow(target: value_types.IntegerType) -> bytes:
    if target.bits >= 32:
        return b""
    if target.signed:
        return I32_EXTEND8_S if target.bits == 8 else I32_EXTEND16_S
    return constant(I32, target.most) + I32_AND
