"""Modules with one fault in a walk or a table, as a defect in the generator of walks may cause."""

import struct
from collections.abc import Iterator
from dataclasses import replace

from rosmop.fast.batch_codegen import WasmModule
from rosmop.fast.wasm import signed, unsigned
from rosmop.prove import decoding

_OPCODES = {name: code for code, name in (decoding.PLAIN | decoding.MEMORY).items()}
_PAIRS = (("add", "sub"), ("and", "or"), ("eq", "ne"), ("shl", "shr_u"), ("lt_s", "ge_s"), ("lt_s", "le_s"),
          ("lt_u", "ge_u"), ("gt_s", "le_s"), ("gt_s", "ge_s"), ("mul", "add"), ("gt_u", "le_u"), ("ge_u", "lt_u"),
          ("shr_s", "shl"), ("eq", "gt_u"))  # fmt: skip


class _Reader(decoding.Reader):
    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.found: list[tuple[int, int, decoding.WasmInstruction]] = []

    def instruction(self, code: int) -> decoding.WasmInstruction:
        begin = self.at - 1
        instruction = super().instruction(code)
        if not instruction.body and not instruction.otherwise:
            self.found.append((begin, self.at, instruction))
        return instruction


def _others(instruction: decoding.WasmInstruction, kinds: list[str]) -> Iterator[tuple[str, bytes]]:
    yield from _calculations(instruction)
    yield from _places(instruction, kinds)
    yield from _ways(instruction)


def _calculations(instruction: decoding.WasmInstruction) -> Iterator[tuple[str, bytes]]:
    family, _, name = instruction.name.partition(".")
    for left, right in _PAIRS:
        for here, other in ((left, right), (right, left)):
            if name == here:
                yield "operation", bytes((_OPCODES[f"{family}.{other}"],))
    if name == "const":
        code = b"\x41" if family == "i32" else b"\x42"
        whole = int(instruction.operands[0])
        for value in {whole + 1, whole - 1, whole ^ 2}:
            yield "constant", code + signed(value)


def _places(one: decoding.WasmInstruction, kinds: list[str]) -> Iterator[tuple[str, bytes]]:
    if one.name in ("local.get", "local.set"):
        code = b"\x20" if one.name == "local.get" else b"\x21"
        place = int(one.operands[0])
        for near in {(place + step) % len(kinds) for step in (1, 2, -1)}:
            if kinds[near] == kinds[place]:
                yield "local", code + unsigned(near)
    if ".load" in one.name or ".store" in one.name:
        for step in (8, 2, -8):
            yield (
                "address",
                bytes((_OPCODES[one.name],)) + b"\x00" + unsigned(max(0, int(one.operands[0]) + step)),
            )


def _ways(one: decoding.WasmInstruction) -> Iterator[tuple[str, bytes]]:
    if one.name in ("br", "br_if"):
        for step in (1, -1):
            if int(one.operands[0]) + step >= 0:
                yield (
                    "branch",
                    (b"\x0c" if one.name == "br" else b"\x0d") + unsigned(int(one.operands[0]) + step),
                )
        if one.name == "br_if":
            yield "branch", b"\x1a"  # the condition is ignored
    if one.name == "call":
        yield "call", b"\x10" + unsigned(int(one.operands[0]) ^ 1)


def walks(module: WasmModule) -> Iterator[tuple[str, str, WasmModule]]:
    code = module.code
    at = 8
    while code[at] != 10:
        reader = _Reader(code)
        reader.at = at + 1
        size = reader.read_unsigned()
        at = reader.at + size
    section = at
    reader = _Reader(code)
    reader.at = at + 1
    reader.read_unsigned()
    end_of_size = reader.at
    count = reader.read_unsigned()
    bodies = []
    head = code[end_of_size : reader.at]
    for _ in range(count):
        size = reader.read_unsigned()
        bodies.append(reader.take(size))
    rest = code[reader.at :]
    number = module.functions
    inner = _Reader(bodies[number])
    kinds = list(decoding.functions_of(code)[number].parameters)
    for _ in range(inner.read_unsigned()):
        many = inner.read_unsigned()
        kinds += [decoding.TYPES[inner.byte()]] * many
    inner.block()
    for begin, end, one in inner.found:
        for kind, other in _others(one, kinds):
            bodies_now = [*bodies]
            bodies_now[number] = bodies[number][:begin] + other + bodies[number][end:]
            content = head + b"".join(unsigned(len(body)) + body for body in bodies_now)
            made = code[:section] + b"\x0a" + unsigned(len(content)) + content + rest
            yield kind, f"{one.name} {one.operands} at {begin}", replace(module, code=made)


def tables(module: WasmModule) -> Iterator[tuple[str, str, WasmModule]]:
    code = module.code
    reader = _Reader(code)
    reader.at = 8
    while code[reader.at] != 11:
        reader.byte()
        reader.take(reader.read_unsigned())
    reader.byte()
    reader.read_unsigned()
    for _ in range(reader.read_unsigned()):
        reader.byte()
        reader.block()
        size = reader.read_unsigned()
        for cell in range(reader.at, reader.at + size - 1, 2):
            (value,) = struct.unpack_from("<h", code, cell)
            made = code[:cell] + struct.pack("<h", value ^ 1) + code[cell + 2 :]
            yield "table", f"cell at {cell}", replace(module, code=made)
        reader.at += size
