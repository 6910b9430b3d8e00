"""Decode a module into functions. Only the instructions that `rosmop/fast` writes are known."""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType


class UnknownInstructionError(Exception):
    """An instruction or element of a module that is not known here."""


@dataclass(frozen=True, slots=True)
class WasmInstruction:
    """An instruction: `operands` are constants, or the type of a block. A block has a `body`; `if` also has the branch
    `otherwise`.
    """

    name: str
    operands: tuple[int | float, ...] = ()
    body: "tuple[WasmInstruction, ...]" = ()
    otherwise: "tuple[WasmInstruction, ...]" = ()


@dataclass(frozen=True, slots=True)
class Code:
    """A decoded function. `made` are its local variables; types are "i32", "f64", …."""

    parameters: tuple[str, ...]
    result: str
    made: tuple[str, ...]
    body: tuple[WasmInstruction, ...]


TYPES = {0x7F: "i32", 0x7E: "i64", 0x7D: "f32", 0x7C: "f64"}
_COMPARED = "eq ne lt_s lt_u gt_s gt_u le_s le_u ge_s ge_u"
_COMPARED_FLOATS = "eq ne lt gt le ge"
_CALCULATED = "clz ctz popcnt add sub mul div_s div_u rem_s rem_u and or xor shl shr_s shr_u"
_CALCULATED_FLOATS = "abs neg ceil floor trunc nearest sqrt add sub mul div min max copysign"
_CONVERTED = """i32.wrap_i64 i32.trunc_f32_s i32.trunc_f32_u i32.trunc_f64_s i32.trunc_f64_u i64.extend_i32_s
    i64.extend_i32_u i64.trunc_f32_s i64.trunc_f32_u i64.trunc_f64_s i64.trunc_f64_u f32.convert_i32_s f32.convert_i32_u
    f32.convert_i64_s f32.convert_i64_u f32.demote_f64 f64.convert_i32_s f64.convert_i32_u f64.convert_i64_s
    f64.convert_i64_u f64.promote_f32 i32.reinterpret_f32 i64.reinterpret_f64 f32.reinterpret_i32 f64.reinterpret_i64
    i32.extend8_s i32.extend16_s"""
_ACCESSES = """i32.load i64.load f32.load f64.load i32.load8_s i32.load8_u i32.load16_s i32.load16_u i64.load8_s
    i64.load8_u i64.load16_s i64.load16_u i64.load32_s i64.load32_u i32.store i64.store f32.store f64.store i32.store8
    i32.store16"""
_TRUNCATED = """i32.trunc_sat_f32_s i32.trunc_sat_f32_u i32.trunc_sat_f64_s i32.trunc_sat_f64_u i64.trunc_sat_f32_s
    i64.trunc_sat_f32_u i64.trunc_sat_f64_s i64.trunc_sat_f64_u"""


def _plain() -> dict[int, str]:
    found = {
        0x00: "unreachable",
        0x0F: "return",
        0x1A: "drop",
        0x1B: "select",
        0x45: "i32.eqz",
        0x50: "i64.eqz",
    }
    rows = (
        (0x46, "i32", _COMPARED), (0x51, "i64", _COMPARED), (0x5B, "f32", _COMPARED_FLOATS),
        (0x61, "f64", _COMPARED_FLOATS), (0x67, "i32", _CALCULATED), (0x79, "i64", _CALCULATED),
        (0x8B, "f32", _CALCULATED_FLOATS), (0x99, "f64", _CALCULATED_FLOATS),
    )  # fmt: skip
    for first, kind, names in rows:
        found |= {first + place: f"{kind}.{name}" for place, name in enumerate(names.split())}
    return found | {0xA7 + place: name for place, name in enumerate(_CONVERTED.split())}


PLAIN: Mapping[int, str] = MappingProxyType(_plain())
MEMORY = MappingProxyType({0x28 + place: name for place, name in enumerate(_ACCESSES.split())})
TRUNCATING = MappingProxyType(dict(enumerate(_TRUNCATED.split())))
NUMBERED = MappingProxyType({0x0C: "br", 0x0D: "br_if", 0x10: "call", 0x20: "local.get", 0x21: "local.set"})
BLOCKS = MappingProxyType({0x02: "block", 0x03: "loop", 0x04: "if"})
_ELSE, _END = 0x05, 0x0B
_TYPES, _CHOSEN, EXPORTS, CODES = 1, 3, 7, 10  # sections
_COPY, _FILL = 10, 11  # the byte after 0xFC
_FLOATS = MappingProxyType(
    {0x43: ("f32.const", struct.Struct("<f")), 0x44: ("f64.const", struct.Struct("<d"))}
)


class Reader:
    """Reads a module from `at` on."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0

    def byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def read_unsigned(self) -> int:
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def read_signed(self) -> int:
        begun = self.at
        value = self.read_unsigned()
        bits = 7 * (self.at - begun)
        return value - (value >> bits - 1 << bits)

    def take(self, size: int) -> bytes:
        self.at += size
        return self._data[self.at - size : self.at]

    def types(self) -> tuple[str, ...]:
        return tuple(TYPES[self.byte()] for _ in range(self.read_unsigned()))

    def block(self) -> tuple[tuple[WasmInstruction, ...], int]:
        instructions: list[WasmInstruction] = []
        while True:
            code = self.byte()
            if code in (_ELSE, _END):
                return tuple(instructions), code
            instructions.append(self.instruction(code))

    def instruction(self, code: int) -> WasmInstruction:
        if code in PLAIN:
            return WasmInstruction(PLAIN[code])
        if code in MEMORY:
            self.read_unsigned()  # the alignment, which is only a hint
            return WasmInstruction(MEMORY[code], (self.read_unsigned(),))
        if code in NUMBERED:
            return WasmInstruction(NUMBERED[code], (self.read_unsigned(),))
        if code in BLOCKS:
            kind = self.byte()
            body, end = self.block()
            otherwise = self.block()[0] if end == _ELSE else ()
            return WasmInstruction(BLOCKS[code], (kind,), body, otherwise)
        if code in (0x41, 0x42):
            return WasmInstruction("i32.const" if code == 0x41 else "i64.const", (self.read_signed(),))
        if code in _FLOATS:
            name, layout = _FLOATS[code]
            return WasmInstruction(name, layout.unpack(self.take(layout.size)))
        number = self.read_unsigned() if code == 0xFC else -1
        if number in TRUNCATING:
            return WasmInstruction(TRUNCATING[number])
        if number == _COPY:
            return WasmInstruction("memory.copy", tuple(self.take(2)))
        if number == _FILL:
            return WasmInstruction("memory.fill", tuple(self.take(1)))
        raise UnknownInstructionError(f"the instruction {code:#04x}")


def sections(module: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the content of each section."""
    reader = Reader(module)
    reader.take(8)
    while reader.at < len(module):
        yield reader.byte(), reader.take(reader.read_unsigned())


def functions_of(module: bytes) -> list[Code]:
    """Return the functions of a module without imports.

    Raises `UnknownInstructionError`, `KeyError` for an unknown type, and `IndexError` if the module ends too
    early.
    """
    types: list[tuple[tuple[str, ...], tuple[str, ...]]] = []
    chosen: list[int] = []
    functions: list[Code] = []
    for section, content in sections(module):
        reader = Reader(content)
        for _ in range(reader.read_unsigned() if section in (_TYPES, _CHOSEN, CODES) else 0):
            if section == _TYPES:
                reader.byte()
                types.append((reader.types(), reader.types()))
            elif section == _CHOSEN:
                chosen.append(reader.read_unsigned())
            else:
                reader.read_unsigned()
                parameters, results = types[chosen[len(functions)]]
                made: list[str] = []
                for _ in range(reader.read_unsigned()):
                    count = reader.read_unsigned()
                    made += [TYPES[reader.byte()]] * count
                functions.append(Code(parameters, results[0], tuple(made), reader.block()[0]))
    return functions
