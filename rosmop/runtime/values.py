"""Operations on values by type: size, zeros, copies, and encoding in messages."""

import operator
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import groupby
from typing import Any, TypeVar

from rosmop.runtime import vectors, wire
from rosmop.runtime.action_context import Context
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.value_types import Type, Value

_CODES = {
    (True, 8): "b",
    (False, 8): "B",
    (True, 16): "h",
    (False, 16): "H",
    (True, 32): "i",
    (False, 32): "I",
    (True, 64): "q",
    (False, 64): "Q",
}
_MOMENTS: dict[Type, str] = {value_types.TIME: "II", value_types.DURATION: "ii"}
BILLION = 1_000_000_000
_Made = TypeVar("_Made")


def struct_code(kind: Type) -> str | None:
    """Return the `struct` code of a type: two for a time, None for a type without a fixed size."""
    if isinstance(kind, value_types.BoolType):
        return "?"
    if isinstance(kind, value_types.IntegerType):
        return _CODES[kind.signed, kind.bits]
    if isinstance(kind, value_types.FloatingType):
        return "f" if kind.bits == 32 else "d"
    return _MOMENTS.get(kind)


def struct_size(codes: str) -> int:
    return sum({"?": 1, "b": 1, "h": 2, "i": 4, "q": 8, "f": 4, "d": 8}[code.lower()] for code in codes)


class ValueCodec:
    """Encodes, decodes, copies and measures values; functions are cached by type."""

    def __init__(self, messages: MessageTypes, check: Callable[[int], None] = lambda _: None) -> None:
        """`check` is called while many elements are walked, with the number of the next ones, and may raise."""
        self._messages = messages
        self._check = check
        self._made: dict[tuple[Callable[[ValueCodec, Any], Any], Type], Any] = {}

    def _once(self, make: Callable[["ValueCodec", Any], _Made], kind: Type) -> _Made:
        if (make, kind) not in self._made:
            self._made[make, kind] = make(self, kind)
        found: _Made = self._made[make, kind]
        return found

    def fields(self, kind: value_types.RecordType) -> list[Type]:
        return [slot.type for slot in self._messages.slots(kind.name).values()]

    # Sizes

    def width(self, kind: Type) -> int:
        if isinstance(kind, value_types.IntegerType | value_types.FloatingType):
            return kind.bits // 8
        if isinstance(kind, value_types.RecordType):
            return sum(map(self.width, self.fields(kind))) or 1
        if isinstance(kind, value_types.VectorType) and kind.length is not None:
            return kind.length * self.width(kind.element)
        return (
            1
            if isinstance(kind, value_types.BoolType)
            else 8
            if kind in (value_types.TIME, value_types.DURATION)
            else 32
        )

    def least(self, kind: Type) -> int:
        """Return the encoded size of the shortest value."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, value_types.RecordType):
            return self._messages.definitions.layout(kind.name).minimum
        if isinstance(kind, value_types.VectorType) and kind.length is not None:
            return kind.length * self.least(kind.element)
        return 4

    def measure(self, kind: Type) -> Callable[[Any], int]:
        return self._once(ValueCodec._measure, kind)

    def _measure(self, kind: Type) -> Callable[[Any], int]:
        if isinstance(kind, value_types.StringType | value_types.CharactersType):
            return len
        if isinstance(kind, value_types.VectorType):
            width, inner = self.width(kind.element), self.measure(kind.element)
            if struct_code(kind.element):
                return lambda values: len(values) * width
            return lambda values: len(values) * width + sum(map(inner, values))
        if isinstance(kind, value_types.RecordType):
            large = [
                (index, self.measure(field))
                for index, field in enumerate(self.fields(kind))
                if not struct_code(field)
            ]
            own = self.width(kind)
            if not large:
                return lambda _: own
            return lambda record: own + sum(measure(record[index]) for index, measure in large)
        return lambda _: 8

    # Comparisons

    def same(self, kind: Type) -> Callable[[Any, Any], bool]:
        """Return a function that compares two values as C++ does: NaN equals nothing, not even itself."""
        numbers = self._once(ValueCodec._numbers, kind)
        return operator.eq if numbers is None else lambda left, right: left == right and numbers(left)

    def _numbers(self, kind: Type) -> Callable[[Any], bool] | None:
        """Return a function that finds out that no number is NaN, or None if the type has no such numbers."""
        if isinstance(kind, value_types.FloatingType):
            return lambda value: value == value  # noqa: PLR0124  NaN
        if isinstance(kind, value_types.RecordType):
            found = [self._once(ValueCodec._numbers, field) for field in self.fields(kind)]
            parts = [(index, test) for index, test in enumerate(found) if test is not None]
            return (lambda record: all(test(record[index]) for index, test in parts)) if parts else None
        if not isinstance(kind, value_types.VectorType):
            return None
        if isinstance(kind.element, value_types.FloatingType):
            return lambda values: all(map(operator.eq, values, values))
        element = self._once(ValueCodec._numbers, kind.element)
        return element and (lambda values: all(map(element, vectors.in_parts(values, self._check))))

    # Zeros and copies

    def maker(self, kind: Type) -> Callable[[], Any]:
        return self._once(ValueCodec._maker, kind)

    def _maker(self, kind: Type) -> Callable[[], Any]:
        if isinstance(kind, value_types.VectorType):
            make, length, element = self.maker(kind.element), kind.length or 0, zero_of(kind.element)
            return lambda: [make() for _ in range(length)] if element is None else [element] * length
        if isinstance(kind, value_types.RecordType):
            makers = [self.maker(field) for field in self.fields(kind)]
            return lambda: [make() for make in makers]
        zero = zero_of(kind)
        return lambda: zero

    def copier(self, kind: Type) -> Callable[[Context, Any, int], Any]:
        return self._once(ValueCodec._copier, kind)

    def _copier(self, kind: Type) -> Callable[[Context, Any, int], Any]:
        if isinstance(kind, value_types.RecordType):
            copies = [
                None if value_types.is_scalar(field) else self.copier(field) for field in self.fields(kind)
            ]
            return lambda context, record, site: [
                part if copy is None else copy(context, part, site)
                for copy, part in zip(copies, record, strict=True)
            ]
        if not isinstance(kind, value_types.VectorType):
            return lambda _context, value, _site: value
        width, element = self.width(kind.element), self.copier(kind.element)
        if value_types.is_scalar(kind.element):
            return lambda context, values, site: vectors.copy(context, values, width, site)
        return lambda context, values, site: vectors.copied_deep(context, values, width, element, site)

    # In a message

    def decoder(self, kind: Type) -> Callable[[wire.Buffer, int], tuple[Any, int]]:
        return (
            wire.text if isinstance(kind, value_types.StringType) else self._once(ValueCodec._decoder, kind)
        )

    def _decoder(self, kind: Type) -> Callable[[wire.Buffer, int], tuple[Any, int]]:
        if isinstance(kind, value_types.VectorType):
            return self._decoder_of_vectors(kind)
        if not isinstance(kind, value_types.RecordType):
            numbers = unpacker([struct_code(kind) or ""])

            def number(buffer: wire.Buffer, start: int) -> tuple[float, int]:
                (value,), end = numbers(buffer, start)
                return value, end

            return number
        parts = [
            (True, unpacker([struct_code(field) or "" for field in run]))
            if fixed
            else (False, self.decoder(run[0]))
            for fixed, run in self._runs(kind)
        ]

        def record(buffer: wire.Buffer, start: int) -> tuple[list[Value], int]:
            values: list[Any] = []
            for several, decode in parts:
                found, start = decode(buffer, start)
                if several:
                    values += found
                else:
                    values.append(found)
            return values, start

        return record

    def _decoder_of_vectors(
        self, kind: value_types.VectorType
    ) -> Callable[[wire.Buffer, int], tuple[Any, int]]:
        code, least, element = struct_code(kind.element), self.least(kind.element), kind.element
        decode: Callable[[wire.Buffer, int, int], tuple[Any, int]]
        fields = self.fields(element) if isinstance(element, value_types.RecordType) else []
        if fields and all(isinstance(field, value_types.StringType) for field in fields):
            decode = partial(wire.rows, width=len(fields), check=self._check)
        elif code is None:
            decode = partial(wire.elements, decode=self.decoder(element), check=self._check)
        elif len(code) == 2:
            decode = partial(wire.moments, code=code[0])
        else:
            decode = partial(wire.numbers, code=code, size=least)
        length = kind.length
        if length is not None:
            return lambda buffer, start: decode(buffer, start, length)
        return lambda buffer, start: decode(buffer, start + 4, wire.count(buffer, start, least))

    def encoder(self, kind: Type) -> Callable[[Any, bytearray], None]:
        return (
            wire.put_text
            if isinstance(kind, value_types.StringType)
            else self._once(ValueCodec._encoder, kind)
        )

    def _encoder(self, kind: Type) -> Callable[[Any, bytearray], None]:
        if isinstance(kind, value_types.VectorType):
            return self._encoder_of_vectors(kind)
        if not isinstance(kind, value_types.RecordType):
            pack_one = packer([struct_code(kind) or ""])
            return lambda value, out: out.extend(pack_one((value,)))
        parts: list[tuple[int, int, Any, Any]] = []
        at = 0
        for fixed, run in self._runs(kind):
            pack = packer([struct_code(field) or "" for field in run]) if fixed else None
            parts.append((at, at + len(run), pack, None if fixed else self.encoder(run[0])))
            at += len(run)

        def record(value: Any, out: bytearray) -> None:
            for first, end, pack, encode in parts:
                if pack is not None:
                    out += pack(value[first:end])
                else:
                    encode(value[first], out)

        return record

    def _encoder_of_vectors(self, kind: value_types.VectorType) -> Callable[[Any, bytearray], None]:
        code, length = struct_code(kind.element) or "", kind.length
        encode = None if code else self.encoder(kind.element)

        def vector(values: Any, out: bytearray) -> None:
            if length is None:
                out += struct.pack("<I", len(values))
            else:
                vectors.require_count(values, length, -1)
            if encode is not None:
                for value in vectors.in_parts(values, self._check):
                    encode(value, out)
            elif len(code) == 2:
                wire.put_moments(values, code[0], out)
            else:
                wire.put_numbers(values, code, out)

        return vector

    def _runs(self, kind: value_types.RecordType) -> Iterator[tuple[bool, list[Type]]]:
        for fixed, run in groupby(self.fields(kind), lambda field: struct_code(field) is not None):
            if fixed:
                yield True, list(run)
            else:
                yield from ((False, [field]) for field in run)


def zero_of(kind: Type) -> bool | float | bytes | None:
    if isinstance(kind, value_types.BoolType):
        return False
    if isinstance(kind, value_types.FloatingType):
        return 0.0
    if isinstance(kind, value_types.IntegerType | value_types.TimeType | value_types.DurationType):
        return 0
    return b"" if isinstance(kind, value_types.StringType | value_types.CharactersType) else None


def unpacker(codes: Sequence[str]) -> Callable[[wire.Buffer, int], tuple[Sequence[float], int]]:
    plain = struct.Struct("<" + "".join(codes))
    unpack, size = plain.unpack_from, plain.size
    if all(len(code) == 1 for code in codes):
        return lambda buffer, start: (unpack(buffer, start), start + size)

    def numbers(buffer: wire.Buffer, start: int) -> tuple[Sequence[float], int]:
        parts = iter(unpack(buffer, start))
        return [
            next(parts) * BILLION + next(parts) if len(code) == 2 else next(parts) for code in codes
        ], start + size

    return numbers


def packer(codes: Sequence[str]) -> Callable[[Sequence[float]], bytes]:
    pack = struct.Struct("<" + "".join(codes)).pack
    if all(len(code) == 1 for code in codes):
        return lambda values: pack(*values)

    def pack_values(values: Sequence[float]) -> bytes:
        parts: list[float] = []
        for code, value in zip(codes, values, strict=True):
            parts += divmod(value, BILLION) if len(code) == 2 else (value,)
        return pack(*parts)

    return pack_values
