"""Messages that variables keep, as values of Python and as they stand in the memory of a module (`records.py`)."""

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from appliance.rosmop.ir.abi import BEYOND
from appliance.rosmop.ir.values import Values, packer, struct_code, unpacker
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

_ADDRESS = 0xFFFFFFFF
_TRUTH = struct.Struct("<q")


class KeptMessage:
    """One, of numbers, times, strings and arrays of fixed length; `texts` are where strings may be put, by where they
    are noted. Whether it is there stands at `known`: one with a time that no message can have, or with more or fewer
    elements than an array has, is not.
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
            (number, next(buffers)) for number, leaf in enumerate(leaves) if isinstance(leaf, kinds.String)
        ]

    def enter(self, memory: memoryview, value: Any, entered: Callable[[bytes, int], int]) -> None:
        """Put it into the memory; `entered` does that with a string, and says what is noted of it."""
        try:
            leaves = [*self._leaves(self._kind, value)]
            for number, buffer in self._texts:
                leaves[number] = entered(leaves[number], buffer)
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
        for number, _ in self._texts:
            at, size = leaves[number] & _ADDRESS, leaves[number] >> 32
            leaves[number] = old[number] if size == BEYOND else bytes(memory[at : at + size])
        return self._built(self._kind, iter(leaves))

    def _parts(self, kind: Type) -> list[Type] | None:
        """The types of what a message or array is made of, in order; None of what stands for itself."""
        if isinstance(kind, kinds.Vector):
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
