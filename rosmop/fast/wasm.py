"""Encode a WebAssembly module. Only this file has opcodes; instructions have the names of the specification."""

import struct
from collections.abc import Sequence
from functools import partial

I32, I64, F32, F64 = 0x7F, 0x7E, 0x7D, 0x7C

HEADER = b"\0asm\x01\0\0\0"
FUNCTION_TYPE = b"\x60"
EXPORTED_FUNCTION = b"\x00"
EXPORTED_MEMORY = b"\x02\x00"
LIMITED = b"\x01"
ACTIVE = b"\x00"

NOTHING = b"\x40"
IF, ELSE, END, RETURN, DROP, SELECT = b"\x04", b"\x05", b"\x0b", b"\x0f", b"\x1a", b"\x1b"
BLOCK, LOOP = b"\x02" + NOTHING, b"\x03" + NOTHING
UNREACHABLE = b"\x00"


def _codes(first: int, last: int) -> list[bytes]:
    return [bytes((code,)) for code in range(first, last + 1)]


(
    I32_EQZ, I32_EQ, I32_NE, I32_LT_S, I32_LT_U, I32_GT_S, I32_GT_U, I32_LE_S, I32_LE_U, I32_GE_S, I32_GE_U,
    I64_EQZ, I64_EQ, I64_NE, I64_LT_S, I64_LT_U, I64_GT_S, I64_GT_U, I64_LE_S, I64_LE_U, I64_GE_S, I64_GE_U,
    F32_EQ, F32_NE, F32_LT, F32_GT, F32_LE, F32_GE, F64_EQ, F64_NE, F64_LT, F64_GT, F64_LE, F64_GE,
) = _codes(0x45, 0x66)  # fmt: skip
(
    I32_ADD, I32_SUB, I32_MUL, I32_DIV_S, I32_DIV_U, I32_REM_S, I32_REM_U, I32_AND, I32_OR, I32_XOR, I32_SHL, I32_SHR_S,
    I32_SHR_U,
) = _codes(0x6A, 0x76)  # fmt: skip
(
    I64_ADD, I64_SUB, I64_MUL, I64_DIV_S, I64_DIV_U, I64_REM_S, I64_REM_U, I64_AND, I64_OR, I64_XOR, I64_SHL, I64_SHR_S,
    I64_SHR_U,
) = _codes(0x7C, 0x88)  # fmt: skip
(
    F32_ABS, F32_NEG, F32_CEIL, F32_FLOOR, F32_TRUNC, F32_NEAREST, F32_SQRT, F32_ADD, F32_SUB, F32_MUL, F32_DIV,
) = _codes(0x8B, 0x95)  # fmt: skip
(
    F64_ABS, F64_NEG, F64_CEIL, F64_FLOOR, F64_TRUNC, F64_NEAREST, F64_SQRT, F64_ADD, F64_SUB, F64_MUL, F64_DIV,
) = _codes(0x99, 0xA3)  # fmt: skip
F32_COPYSIGN, F64_COPYSIGN = b"\x98", b"\xa6"
I32_WRAP_I64, I64_EXTEND_I32_S, I64_EXTEND_I32_U = b"\xa7", b"\xac", b"\xad"
(
    F32_CONVERT_I32_S, F32_CONVERT_I32_U, F32_CONVERT_I64_S, F32_CONVERT_I64_U, F32_DEMOTE_F64,
    F64_CONVERT_I32_S, F64_CONVERT_I32_U, F64_CONVERT_I64_S, F64_CONVERT_I64_U, F64_PROMOTE_F32,
    I32_REINTERPRET_F32, I64_REINTERPRET_F64,
) = _codes(0xB2, 0xBD)  # fmt: skip
I32_EXTEND8_S, I32_EXTEND16_S = b"\xc0", b"\xc1"
I32_TRUNC_SAT_F64_S, I32_TRUNC_SAT_F64_U = b"\xfc\x02", b"\xfc\x03"
I64_TRUNC_SAT_F64_S, I64_TRUNC_SAT_F64_U = b"\xfc\x06", b"\xfc\x07"
MEMORY_COPY = b"\xfc\x0a\x00\x00"


def unsigned(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def signed(value: int) -> bytes:
    out = bytearray()
    while not -64 <= value < 64:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value & 0x7F))


def row(items: Sequence[bytes]) -> bytes:
    return unsigned(len(items)) + b"".join(items)


def text(name: str) -> bytes:
    return unsigned(len(name)) + name.encode()


def section(number: int, content: bytes) -> bytes:
    return bytes((number,)) + unsigned(len(content)) + content


def function_type(parameters: Sequence[int], result: int) -> bytes:
    return FUNCTION_TYPE + row([bytes((kind,)) for kind in parameters]) + row([bytes((result,))])


def function(made: Sequence[tuple[int, int]], code: bytes) -> bytes:
    """Encode a function. `made` has the number and type of its locals; `code` has no final `END`."""
    whole = row([unsigned(count) + bytes((machine,)) for count, machine in made]) + code + END
    return unsigned(len(whole)) + whole


def _instruction(opcode: bytes, operand: int) -> bytes:
    return opcode + unsigned(operand)


br, br_if, call = (
    partial(_instruction, b"\x0c"),
    partial(_instruction, b"\x0d"),
    partial(_instruction, b"\x10"),
)
local_get, local_set = partial(_instruction, b"\x20"), partial(_instruction, b"\x21")

# Loads and stores, by their offset, without a promised alignment.
i32_load, i64_load = partial(_instruction, b"\x28\x00"), partial(_instruction, b"\x29\x00")
f32_load, f64_load = partial(_instruction, b"\x2a\x00"), partial(_instruction, b"\x2b\x00")
i32_load8_s, i32_load8_u = partial(_instruction, b"\x2c\x00"), partial(_instruction, b"\x2d\x00")
i32_load16_s, i32_load16_u = partial(_instruction, b"\x2e\x00"), partial(_instruction, b"\x2f\x00")
i64_load8_u, i64_load32_u = partial(_instruction, b"\x31\x00"), partial(_instruction, b"\x35\x00")
i32_store, i64_store = partial(_instruction, b"\x36\x00"), partial(_instruction, b"\x37\x00")
f32_store, f64_store = partial(_instruction, b"\x38\x00"), partial(_instruction, b"\x39\x00")
i32_store8, i32_store16 = partial(_instruction, b"\x3a\x00"), partial(_instruction, b"\x3b\x00")

_LOADS = {I32: i32_load, I64: i64_load, F32: f32_load, F64: f64_load}
_STORES = {I32: i32_store, I64: i64_store, F32: f32_store, F64: f64_store}


def if_result(machine: int) -> bytes:
    return IF + bytes((machine,))


def constant(machine: int, value: float) -> bytes:
    if machine in (I32, I64):
        bits = 32 if machine == I32 else 64
        whole = int(value) & (1 << bits) - 1
        return (b"\x41" if bits == 32 else b"\x42") + signed(whole - (whole >> bits - 1 << bits))
    return b"\x43" + struct.pack("<f", value) if machine == F32 else b"\x44" + struct.pack("<d", value)


def load(machine: int, address: int) -> bytes:
    return constant(I32, 0) + _LOADS[machine](address)


def store(machine: int, address: int, value: bytes) -> bytes:
    return constant(I32, 0) + value + _STORES[machine](address)


# Instructions by the operators of the language

_COMPARISONS = {
    (I32, True): {"==": I32_EQ, "!=": I32_NE, "<": I32_LT_S, ">": I32_GT_S, "<=": I32_LE_S, ">=": I32_GE_S},
    (I32, False): {"==": I32_EQ, "!=": I32_NE, "<": I32_LT_U, ">": I32_GT_U, "<=": I32_LE_U, ">=": I32_GE_U},
    (I64, True): {"==": I64_EQ, "!=": I64_NE, "<": I64_LT_S, ">": I64_GT_S, "<=": I64_LE_S, ">=": I64_GE_S},
    (I64, False): {"==": I64_EQ, "!=": I64_NE, "<": I64_LT_U, ">": I64_GT_U, "<=": I64_LE_U, ">=": I64_GE_U},
    (F32, True): {"==": F32_EQ, "!=": F32_NE, "<": F32_LT, ">": F32_GT, "<=": F32_LE, ">=": F32_GE},
    (F64, True): {"==": F64_EQ, "!=": F64_NE, "<": F64_LT, ">": F64_GT, "<=": F64_LE, ">=": F64_GE},
}
_CALCULATIONS = {
    (I32, True): {"+": I32_ADD, "-": I32_SUB, "*": I32_MUL, "/": I32_DIV_S, "%": I32_REM_S, "&": I32_AND, "|": I32_OR,
                  "^": I32_XOR, "<<": I32_SHL, ">>": I32_SHR_S},
    (I32, False): {"+": I32_ADD, "-": I32_SUB, "*": I32_MUL, "/": I32_DIV_U, "%": I32_REM_U, "&": I32_AND, "|": I32_OR,
                   "^": I32_XOR, "<<": I32_SHL, ">>": I32_SHR_U},
    (I64, True): {"+": I64_ADD, "-": I64_SUB, "*": I64_MUL, "/": I64_DIV_S, "%": I64_REM_S, "&": I64_AND, "|": I64_OR,
                  "^": I64_XOR, "<<": I64_SHL, ">>": I64_SHR_S},
    (I64, False): {"+": I64_ADD, "-": I64_SUB, "*": I64_MUL, "/": I64_DIV_U, "%": I64_REM_U, "&": I64_AND, "|": I64_OR,
                   "^": I64_XOR, "<<": I64_SHL, ">>": I64_SHR_U},
    (F32, True): {"+": F32_ADD, "-": F32_SUB, "*": F32_MUL, "/": F32_DIV},
    (F64, True): {"+": F64_ADD, "-": F64_SUB, "*": F64_MUL, "/": F64_DIV},
}  # fmt: skip


def compare(machine: int, operator: str, *, signed: bool = True) -> bytes:
    return _COMPARISONS[machine, signed][operator]


def calculate(machine: int, operator: str, *, signed: bool = True) -> bytes:
    return _CALCULATIONS[machine, signed][operator]
