"""Functions, exports and constants as one WebAssembly module."""

from collections.abc import Mapping, Sequence

from rosmop.fast.wasm import END, I32, constant, row, text, unsigned

PAGE = 1 << 16
"""Memory comes in so many bytes."""


def assembled(
    functions: Sequence[tuple[Sequence[int], int, bytes]],
    exports: Mapping[str, int],
    constants: Mapping[bytes, int],
    memory: int,
) -> bytes:
    """The module of functions (the types of what they take and give, and their code); their numbers by the names that
    they are exported by; bytes that stand in the memory from the beginning, and where; and how much memory there is.
    """
    types = [
        b"\x60" + row([bytes((kind,)) for kind in given]) + row([bytes((result,))])
        for given, result, _ in functions
    ]
    exported = [text(name) + b"\x00" + unsigned(number) for name, number in exports.items()]
    pages = unsigned(memory // PAGE)
    data = [
        b"\x00" + constant(I32, address) + END + unsigned(len(raw)) + raw
        for raw, address in constants.items()
    ]
    sections = (
        (1, row(types)),
        (3, row([unsigned(index) for index in range(len(types))])),
        (5, row([b"\x01" + pages + pages])),
        (7, row([*exported, text("memory") + b"\x02\x00"])),
        (10, row([code for _, _, code in functions])),
        (11, row(data)),
    )
    content = b"".join(bytes((number,)) + unsigned(len(part)) + part for number, part in sections)
    return b"\0asm\x01\0\0\0" + content
