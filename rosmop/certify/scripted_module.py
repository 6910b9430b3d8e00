"""Replace the functions of events and handlers in a finished module with stubs that return scripted results.

Everything else stays byte for byte the same. This file shares no encoder or decoder with `fast/wasm.py`, so
that it cannot repeat an error there. If an address in `WasmModule` is wrong, the module traps or the
comparison in `steps.py` fails, unless the writer uses the same wrong address everywhere.
"""

import struct
from collections.abc import Iterable, Iterator, Mapping

from rosmop.fast.batch_codegen import WasmModule

RECORD, NOTE = struct.Struct("<qqqii"), struct.Struct("<3i")
"""The format of a try's result (answer, first effect, state, end of the notes) and of a call's note (function and two
arguments).
"""
TELL, SCRIPT = 4096, 8192
"""Offsets after the first frame: of the end of the notes, and of the results of the functions."""

_I32, _I64 = b"\x7f", b"\x7e"
_ZEROS = {_I64: b"\x42\x00", b"\x7d": b"\x43" + bytes(4), b"\x7c": b"\x44" + bytes(8)}  # of i64, f32 and f64
_ADD, _LESS = b"\x6a", b"\x48"  # i32.add, i32.lt_s
_NO_RESULT, _LOOP, _IF, _END = b"\x40", b"\x03", b"\x04", b"\x0b"
_COPY_MEMORY = b"\xfc\x0a\x00\x00"


def to_script(module: WasmModule) -> bytes:
    sections = sections_of(module.code)
    types, chosen = list(_types(sections[1])), list(_chosen(sections[3]))
    exports = _exports(sections[7])
    walks = {exports[feed.name] for feed in module.feeds.values()}
    codes = [
        body if number in walks else _stub(module, number, types[number])
        for number, body in enumerate(_bodies(sections[10]))
    ]
    sweeps = []
    for feed in module.feeds.values():
        name = f"try {feed.name}".encode()
        sweeps.append(_leb(len(name)) + name + b"\x00" + _leb(len(codes)))
        types.append(b"\x60" + _vector([*[_I32] * 5, _I64]) + _vector([_I32]))
        chosen.append(_leb(len(types) - 1))
        codes.append(_sweep(module, exports[feed.name]))
    exported = [raw for raw, _name, _number in _read_exports(sections[7])]
    sections |= {1: _vector(types), 3: _vector(chosen), 7: _vector([*exported, *sweeps]), 10: _vector(codes)}
    content = b"".join(bytes((kind,)) + _leb(len(part)) + part for kind, part in sections.items())
    return module.code[:8] + content


def _stub(module: WasmModule, number: int, kind: bytes) -> bytes:
    end, result = module.frames + TELL, kind[-1:]
    code = b""
    if kind[1] >= 2 and kind[2:4] == _I32 + _I32:  # two addresses: an event or a handler
        note = _load_i32(end)
        for index, value in enumerate((_i32(number), _get(0), _get(1))):
            code += note + value + _store(_I32, 4 * index)
        code += _i32(0) + note + _i32(NOTE.size) + _ADD + _store(_I32, end)
    if result == _I32:
        code += _load_i32(module.frames + SCRIPT + 4 * number)
    else:
        code += _ZEROS[result]
    return _function(code)


def _sweep(module: WasmModule, walk: int) -> bytes:
    """Return `try(first, behind, cell, out, end, now)`, which runs the walk with each of these states in `cell`.

    It restores all other state before each run on the frames up to `end`.
    """
    state, last, cell, out, end, now, answer = range(7)
    told, template = module.frames + TELL, module.frames + TELL + 16
    restore = b"".join(_load_i32(template + 4 * index) for index in range(3)) + _COPY_MEMORY
    code = restore + _get(cell) + _get(state) + _store(_I32, 0)
    code += _i32(module.frames) + _get(end) + _get(now) + b"\x10" + _leb(walk) + _set(answer)
    effects = (_i32(0) + b"\x29\x00" + _leb(module.effects + offset) for offset in (16, 24))  # i64.load
    for index, value in enumerate((_get(answer), *effects)):
        code += _get(out) + value + _store(_I64, 8 * index)
    code += _get(out) + _get(cell) + b"\x28\x00\x00" + _store(_I32, 24)
    code += _get(out) + _load_i32(told) + _store(_I32, 28)
    code += _get(out) + _i32(RECORD.size) + _ADD + _set(out)
    code += _get(state) + _i32(1) + _ADD + _set(state)
    again = b"\x0c\x01"  # br to the loop
    loop = _get(state) + _get(last) + _LESS + _IF + _NO_RESULT + code + again + _END
    return _function(_LOOP + _NO_RESULT + loop + _END + _get(out), locals_=[b"\x01" + _I64])


def _leb(value: int) -> bytes:
    groups = [value >> shift & 0x7F for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes(group | 0x80 for group in groups[:-1]) + bytes(groups[-1:])


def _i32(value: int) -> bytes:
    return b"\x41" + bytes(value >> shift & 0x7F | 0x80 for shift in (0, 7, 14, 21)) + bytes((value >> 28,))


def _get(local: int) -> bytes:
    return b"\x20" + _leb(local)


def _set(local: int) -> bytes:
    return b"\x21" + _leb(local)


def _load_i32(address: int) -> bytes:
    return _i32(0) + b"\x28\x00" + _leb(address)


def _store(kind: bytes, offset: int) -> bytes:
    return (b"\x36" if kind == _I32 else b"\x37") + b"\x00" + _leb(offset)


def _vector(items: Iterable[bytes]) -> bytes:
    items = list(items)
    return _leb(len(items)) + b"".join(items)


def _function(code: bytes, locals_: Iterable[bytes] = ()) -> bytes:
    body = _vector(locals_) + code + _END
    return _leb(len(body)) + body


def _read_leb(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def sections_of(code: bytes) -> dict[int, bytes]:
    at, found = 8, {}
    while at < len(code):
        size, begin = _read_leb(code, at + 1)
        found[code[at]] = code[begin : begin + size]
        at = begin + size
    return found


def _types(section: bytes) -> Iterator[bytes]:
    count, at = _read_leb(section, 0)
    for _ in range(count):
        begin = at
        at += 2 + section[at + 1]
        at += 1 + section[at]
        yield section[begin:at]


def _chosen(section: bytes) -> Iterator[bytes]:
    count, at = _read_leb(section, 0)
    for _ in range(count):
        begin = at
        _, at = _read_leb(section, at)
        yield section[begin:at]


def _bodies(section: bytes) -> Iterator[bytes]:
    count, at = _read_leb(section, 0)
    for _ in range(count):
        size, begin = _read_leb(section, at)
        yield section[at : begin + size]
        at = begin + size


def _read_exports(section: bytes) -> Iterator[tuple[bytes, str, int]]:
    count, at = _read_leb(section, 0)
    for _ in range(count):
        size, begin = _read_leb(section, at)
        number, end = _read_leb(section, begin + size + 1)
        yield section[at:end], section[begin : begin + size].decode(), number
        at = end


def _exports(section: bytes) -> Mapping[str, int]:
    return {name: number for _raw, name, number in _read_exports(section)}
