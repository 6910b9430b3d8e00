"""What variables keep, as values of Python and as it stands in the memory of a module (`texts.py`, `vectors.py`,
`records.py`).
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from rosmop.fast.abi import BEYOND, MOST_KEPT, ROOM
from rosmop.runtime.values import Values, is_array, packer, struct_code, struct_size, unpacker
from rosmop.runtime.wire import moments, numbers, put_moments, put_numbers
from rosmop.types import kinds
from rosmop.types.kinds import Type

_ADDRESS = 0xFFFFFFFF
_TRUTH = struct.Struct("<q")


def element_code(kind: Type) -> str:
    """The `struct` code of the elements of a vector; of a string there is none."""
    return struct_code(kind.element) or "" if isinstance(kind, kinds.Vector) else ""


def entered(memory: memoryview, value: Any, buffer: int, code: str) -> int:
    """Put a string or vector there; where it is now, and how long it is (from bit 32 on)."""
    packed: bytes | bytearray = value if not code else bytearray()
    if len(value) * struct_size(code) > ROOM or (not code and len(value) > MOST_KEPT):
        return BEYOND << 32
    try:
        if len(code) == 2:
            put_moments(value, code[0], packed)  # type: ignore[arg-type]  # a vector's
        elif code:
            put_numbers(value, code, packed)  # type: ignore[arg-type]  # the same
    except struct.error:
        return BEYOND << 32  # a time that no message can have
    memory[buffer : buffer + len(packed)] = packed
    return buffer | len(value) << 32


def left(memory: memoryview, word: int, code: str, before: Any) -> Any:
    """The string or vector of which this is noted; what is not there is as it was before."""
    at, count = word & _ADDRESS, word >> 32
    if count == BEYOND:
        return before
    if not code:
        return bytes(memory[at : at + count])
    if len(code) == 2:
        return moments(memory, at, count, code[0])[0]
    return numbers(memory, at, count, code, struct_size(code))[0]


class KeptMessage:
    """A message of numbers, times, strings and arrays of them; `texts` are where its strings and arrays of any length
    may be put, by where they are noted. Whether it is there stands at `known`: one with a time that no message can
    have, or with more or fewer elements than an array of fixed length has, is not.
    """

    def __init__(
        self, values: Values, kind: kinds.Record, begin: int, known: int, texts: Mapping[int, int]
    ) -> None:
        self._values = values
        self._kind = kind
        self._begin = begin
        self._known = known
        leaves = [*self._kinds(kind)]
        codes = [struct_code(leaf) or "Q" for leaf in leaves]
        self._pack, self._unpack = packer(codes), unpacker(codes)
        buffers = iter([texts[at] for at in sorted(texts)])
        self._texts = [
            (number, next(buffers), element_code(leaf))
            for number, leaf in enumerate(leaves)
            if not struct_code(leaf)
        ]

    def enter(self, memory: memoryview, value: Any) -> None:
        """Put it into the memory."""
        try:
            leaves = [*self._leaves(self._kind, value)]
            for number, buffer, code in self._texts:
                leaves[number] = entered(memory, leaves[number], buffer, code)
            raw = self._pack(leaves)
        except (struct.error, ValueError):
            _TRUTH.pack_into(memory, self._known, False)
            return
        memory[self._begin : self._begin + len(raw)] = raw
        _TRUTH.pack_into(memory, self._known, True)

    def left(self, memory: memoryview, before: Any) -> Any:
        """The value that stands there; what is not there is as it was before."""
        if not _TRUTH.unpack_from(memory, self._known)[0]:
            return before
        leaves, old = [*self._unpack(memory, self._begin)[0]], [*self._leaves(self._kind, before)]
        for number, _, code in self._texts:
            leaves[number] = left(memory, leaves[number], code, old[number])
        return self._built(self._kind, iter(leaves))

    def _parts(self, kind: Type) -> list[Type] | None:
        """The types of what a message or array is made of, in order; None of what stands for itself."""
        if isinstance(kind, kinds.Vector) and not is_array(kind):
            return [kind.element] * (kind.length or 0)
        return self._values.fields(kind) if isinstance(kind, kinds.Record) else None

    def _kinds(self, kind: Type) -> Iterator[Type]:
        parts = self._parts(kind)
        if parts is None:
            yield kind
        for inner in parts or ():
            yield from self._kinds(inner)

    def _leaves(self, kind: Type, value: Any) -> Iterator[Any]:
        parts = self._parts(kind)
        if parts is None:
            yield value
            return
        for inner, part in zip(parts, value, strict=True):
            yield from self._leaves(inner, part)

    def _built(self, kind: Type, leaves: Iterator[Any]) -> Any:
        parts = self._parts(kind)
        return next(leaves) if parts is None else [self._built(inner, leaves) for inner in parts]
