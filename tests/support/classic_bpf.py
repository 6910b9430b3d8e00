"""Run a classic BPF program that selects a socket by source address, in Python."""

import struct

import pytest

from appliance.policy.model import Address


def _packet(source: Address) -> tuple[int, bytes]:
    return (0x0800, bytes(12) + source.packed) if source.version == 4 else (0x86DD, bytes(8) + source.packed)


def choose(program: bytes, source: Address) -> int:
    ethertype, header = _packet(source)
    code = list(struct.iter_unpack("HBBI", program))
    accumulator, stored, at = 0, dict[int, int](), 0
    while True:
        operation, if_true, if_false, operand = code[at]
        at += 1
        match operation:
            case 0x06:
                return int(operand)
            case 0x20 if operand == 0xFFFFF000:
                accumulator = ethertype
            case 0x20:
                (accumulator,) = struct.unpack_from(">I", header, operand - 0xFFF00000)
            case 0x60:
                accumulator = stored[operand]
            case 0x02:
                stored[operand] = accumulator
            case 0x54:
                accumulator &= operand
            case 0x05:
                at += operand
            case 0x15:
                at += if_true if accumulator == operand else if_false
            case _:
                pytest.fail(f"instruction {operation:#x}")
