"""A finished module whose functions of events and handlers return what is put down for them.

The walks and the data, tables included, are the same bytes. Behind the frames stand: where calls are noted, what is
copied over the states before each try, and what each function returns.
"""

import struct
from collections.abc import Iterator, Mapping

from rosmop.fast.batch_codegen import WrittenModule
from rosmop.fast.wasm import END, I32, I64, IF, NOTHING, constant, load, row, store, text, unsigned

RECORD, NOTE = struct.Struct("<qqqii"), struct.Struct("<3i")
"""What comes of a try: the answer, the first effect, the state, and where notes end. A call: function and arguments."""
TELL, SCRIPT = 4096, 8192
"""Where it is noted, behind the first frame, where notes end; and what the functions return."""


def scripted(module: WrittenModule) -> bytes:
    """The module with each function that is not a walk replaced, and a function that tries a range of states."""
    sections = sections_of(module.code)
    types, chosen = _types(sections[1]), _chosen(sections[3])
    exports = _exports(sections[7])
    walks = {exports[feed.name] for feed in module.feeds.values()}
    codes = [
        body if number in walks else _stub(module, number, types[number])
        for number, body in enumerate(_bodies(sections[10]))
    ]
    sweeps = []
    for feed in module.feeds.values():
        sweeps.append(text(f"try {feed.name}") + b"\x00" + unsigned(len(codes)))
        types.append(b"\x60" + row([bytes((I32,))] * 5 + [bytes((I64,))]) + row([bytes((I32,))]))
        chosen.append(unsigned(len(types) - 1))
        codes.append(_sweep(module, exports[feed.name]))
    sections |= {1: row(types), 3: row(chosen), 10: row(codes)}
    sections[7] = row([*_raw_exports(sections[7]), *sweeps])
    content = b"".join(bytes((kind,)) + unsigned(len(part)) + part for kind, part in sections.items())
    return module.code[:8] + content


def _stub(module: WrittenModule, number: int, kind: bytes) -> bytes:
    """A function that notes its number and its first two arguments, and returns what stands in the script for it."""
    end, result = module.frames + TELL, kind[-1]
    body = b""
    if kind[1] >= 2 and kind[2:4] == bytes((I32, I32)):  # of two addresses: an event or a handler
        note = load(I32, end)
        for place, value in enumerate((constant(I32, number), b"\x20\x00", b"\x20\x01")):
            body += note + value + b"\x36\x00" + unsigned(4 * place)
        body += store(I32, end, note + constant(I32, NOTE.size) + b"\x6a")
    returned = load(I32, module.frames + SCRIPT + 4 * number) if result == I32 else constant(result, 0)
    body = row([]) + body + returned + END
    return unsigned(len(body)) + body


def _sweep(module: WrittenModule, walk: int) -> bytes:
    """`try(first, behind, cell, out, end, now)`: with each of these states in a cell, over the frames up to `end`; all
    other state is as it stands behind the script.
    """
    state, last, cell, out, end, now, answer = (b"\x20" + unsigned(local) for local in range(7))
    told, template = module.frames + TELL, module.frames + TELL + 16
    restore = load(I32, template) + load(I32, template + 4) + load(I32, template + 8) + b"\xfc\x0a\x00\x00"
    loop = restore + cell + state + b"\x36\x00\x00"
    loop += constant(I32, module.frames) + end + now + b"\x10" + unsigned(walk) + b"\x21\x06"
    for place, value in enumerate((answer, load(I64, module.effects + 16), load(I64, module.effects + 24))):
        loop += out + value + b"\x37\x00" + unsigned(8 * place)
    loop += (
        out
        + cell
        + b"\x28\x00\x00\x36\x00"
        + unsigned(24)
        + out
        + load(I32, told)
        + b"\x36\x00"
        + unsigned(28)
    )
    loop += (
        out
        + constant(I32, RECORD.size)
        + b"\x6a\x21\x03"
        + state
        + constant(I32, 1)
        + b"\x6a\x21\x00\x0c\x01"
    )
    body = (
        row([b"\x01" + bytes((I64,))])
        + b"\x03"
        + NOTHING
        + state
        + last
        + b"\x48"
        + IF
        + NOTHING
        + loop
        + END
        + END
    )
    body += out + END
    return unsigned(len(body)) + body


def _unsigned(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def sections_of(code: bytes) -> dict[int, bytes]:
    """The sections of a module by their numbers, in order."""
    at, found = 8, {}
    while at < len(code):
        size, begin = _unsigned(code, at + 1)
        found[code[at]] = code[begin : begin + size]
        at = begin + size
    return found


def _types(section: bytes) -> list[bytes]:
    """The types of functions; each has at most 127 arguments."""
    count, at = _unsigned(section, 0)
    found = []
    for _ in range(count):
        begin = at
        at += 2 + section[at + 1]
        at += 1 + section[at]
        found.append(section[begin:at])
    return found


def _chosen(section: bytes) -> list[bytes]:
    """The number of each function's type."""
    count, at = _unsigned(section, 0)
    found = []
    for _ in range(count):
        begin = at
        _, at = _unsigned(section, at)
        found.append(section[begin:at])
    return found


def _bodies(section: bytes) -> Iterator[bytes]:
    count, at = _unsigned(section, 0)
    for _ in range(count):
        size, begin = _unsigned(section, at)
        yield section[at : begin + size]
        at = begin + size


def _raw_exports(section: bytes) -> Iterator[bytes]:
    count, at = _unsigned(section, 0)
    for _ in range(count):
        size, begin = _unsigned(section, at)
        _, end = _unsigned(section, begin + size + 1)
        yield section[at:end]
        at = end


def _exports(section: bytes) -> Mapping[str, int]:
    found = {}
    for one in _raw_exports(section):
        size, begin = _unsigned(one, 0)
        found[one[begin : begin + size].decode()] = _unsigned(one, begin + size + 1)[0]
    return found
