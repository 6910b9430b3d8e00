"""Parts of a WebAssembly module as bytes: numbers, names, rows, and the codes of instructions."""

import struct
from collections.abc import Sequence

I32, I64, F32, F64 = 0x7F, 0x7E, 0x7D, 0x7C
IF, ELSE, END, RETURN, DROP, SELECT = b"\x04", b"\x05", b"\x0b", b"\x0f", b"\x1a", b"\x1b"
NOTHING = b"\x40"
UNREACHABLE = b"\x00"
COMPARE = {
    I32: {"==": 0x46, "!=": 0x47, "<": 0x48, ">": 0x4A, "<=": 0x4C, ">=": 0x4E},
    I64: {"==": 0x51, "!=": 0x52, "<": 0x53, ">": 0x55, "<=": 0x57, ">=": 0x59},
    F32: {"==": 0x5B, "!=": 0x5C, "<": 0x5D, ">": 0x5E, "<=": 0x5F, ">=": 0x60},
    F64: {"==": 0x61, "!=": 0x62, "<": 0x63, ">": 0x64, "<=": 0x65, ">=": 0x66},
}
CALCULATE = {
    I32: {"+": 0x6A, "-": 0x6B, "*": 0x6C, "/": 0x6D, "%": 0x6F, "&": 0x71, "|": 0x72, "^": 0x73, "<<": 0x74,
           ">>": 0x75},
    I64: {"+": 0x7C, "-": 0x7D, "*": 0x7E, "/": 0x7F, "%": 0x81, "&": 0x83, "|": 0x84, "^": 0x85, "<<": 0x86,
           ">>": 0x87},
    F32: {"+": 0x92, "-": 0x93, "*": 0x94, "/": 0x95},
    F64: {"+": 0xA0, "-": 0xA1, "*": 0xA2, "/": 0xA3},
}  # fmt: skip
LOAD = {"?": 0x2D, "b": 0x2C, "B": 0x2D, "h": 0x2E, "H": 0x2F, "i": 0x28, "I": 0x28, "q": 0x29, "Q": 0x29, "f": 0x2A,
         "d": 0x2B}  # fmt: skip
MOVES = {8: (0x29, 0x37), 4: (0x28, 0x36), 2: (0x2F, 0x3B), 1: (0x2D, 0x3A)}
"""What loads and stores so many bytes as they are."""

ABS, NEG = {F32: 0x8B, F64: 0x99}, {F32: 0x8C, F64: 0x9A}


def unsigned(value: int) -> bytes:
    """LEB128."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def signed(value: int) -> bytes:
    """The same of a number with a sign."""
    out = bytearray()
    while not -64 <= value < 64:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value & 0x7F))


def row(items: Sequence[bytes]) -> bytes:
    """How many there are, and they."""
    return unsigned(len(items)) + b"".join(items)


def text(name: str) -> bytes:
    """A name."""
    return unsigned(len(name)) + name.encode()


def constant(machine: int, value: float) -> bytes:
    """A number of this type; integers wrap."""
    if machine in (I32, I64):
        bits = 32 if machine == I32 else 64
        whole = int(value) & (1 << bits) - 1
        return (b"\x41" if bits == 32 else b"\x42") + signed(whole - (whole >> bits - 1 << bits))
    return b"\x43" + struct.pack("<f", value) if machine == F32 else b"\x44" + struct.pack("<d", value)


def load(machine: int, address: int) -> bytes:
    """An integer that stands at an address."""
    return constant(I32, 0) + (b"\x28\x00" if machine == I32 else b"\x29\x00") + unsigned(address)


def store(machine: int, address: int, value: bytes) -> bytes:
    """Put an integer at an address."""
    return constant(I32, 0) + value + (b"\x36\x00" if machine == I32 else b"\x37\x00") + unsigned(address)
