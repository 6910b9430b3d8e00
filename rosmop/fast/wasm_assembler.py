"""Functions, exports and constants as one WebAssembly module."""

from collections.abc import Mapping, Sequence

from rosmop.fast.wasm import (
    ACTIVE,
    END,
    EXPORTED_FUNCTION,
    EXPORTED_MEMORY,
    HEADER,
    I32,
    LIMITED,
    constant,
    function_type,
    row,
    section,
    text,
    unsigned,
)

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
    types = [function_type(given, result) for given, result, _ in functions]
    exported = [text(name) + EXPORTED_FUNCTION + unsigned(number) for name, number in exports.items()]
    pages = unsigned(memory // PAGE)
    data = [
        ACTIVE + constant(I32, address) + END + unsigned(len(raw)) + raw for raw, address in constants.items()
    ]
    sections = (
        (1, row(types)),
        (3, row([unsigned(index) for index in range(len(types))])),
        (5, row([LIMITED + pages + pages])),
        (7, row([*exported, text("memory") + EXPORTED_MEMORY])),
        (10, row([code for _, _, code in functions])),
        (11, row(data)),
    )
    return HEADER + b"".join(section(number, part) for number, part in sections)
