"""Encode the functions that `rosmop/prove/decoding.py` decodes, so that wasmtime can run a module with a fault."""

import struct
from collections.abc import Sequence

from rosmop.fast.wasm import row, section, signed, unsigned
from rosmop.prove import decoding
from rosmop.prove.decoding import Code, Reader, WasmInstruction

_CODES = {name: bytes((code,)) for table in (decoding.PLAIN, decoding.BLOCKS, decoding.NUMBERED)
          for code, name in table.items()}  # fmt: skip
_MEMORY = {name: code for code, name in decoding.MEMORY.items()}
_LONG = {name: code for code, name in decoding.TRUNCATING.items()} | {"memory.copy": 10, "memory.fill": 11}
_TYPES = {name: code for code, name in decoding.TYPES.items()}
_END, _ELSE, _MORE = b"\x0b", b"\x05", 0xFC


def with_function(module: bytes, number: int, code: Code) -> bytes:
    """Return a module with another body for one of its functions."""
    parts = dict(decoding.sections(module))
    reader = Reader(parts[decoding.CODES])
    bodies = [reader.take(reader.read_unsigned()) for _ in range(reader.read_unsigned())]
    bodies[number] = _body(code)
    parts[decoding.CODES] = row([unsigned(len(body)) + body for body in bodies])
    return module[:8] + b"".join(section(kind, content) for kind, content in parts.items())


def _body(code: Code) -> bytes:
    made = b"".join(b"\x01" + bytes((_TYPES[kind],)) for kind in code.made)
    return unsigned(len(code.made)) + made + _block(code.body) + _END


def _block(body: Sequence[WasmInstruction]) -> bytes:
    return b"".join(map(_instruction, body))


def _instruction(instruction: WasmInstruction) -> bytes:
    name, operands = instruction.name, instruction.operands
    if name.endswith(".const"):
        return _constant(instruction)
    if name in _MEMORY:
        return bytes((_MEMORY[name], 0)) + unsigned(int(operands[0]))
    if name in _LONG:
        return bytes((_MORE, _LONG[name], *map(int, operands)))
    if name in ("block", "loop", "if"):
        otherwise = _ELSE + _block(instruction.otherwise) if instruction.otherwise else b""
        return _CODES[name] + bytes((int(operands[0]),)) + _block(instruction.body) + otherwise + _END
    return _CODES[name] + b"".join(unsigned(int(operand)) for operand in operands)


def _constant(instruction: WasmInstruction) -> bytes:
    number = instruction.operands[0]
    if instruction.name == "f32.const":
        return b"\x43" + struct.pack("<f", number)
    if instruction.name == "f64.const":
        return b"\x44" + struct.pack("<d", number)
    half = 1 << int(instruction.name[1:3]) - 1
    return (b"\x41" if half >> 32 == 0 else b"\x42") + signed((int(number) + half) % (2 * half) - half)
