"""Values by their types: the bytes they take, zeros, copies, and how they stand in a message.

A message is the list of its fields.
"""

import struct
from collections.abc import Callable
from typing import Any

from appliance.rosmop.runtime import vectors, wire
from appliance.rosmop.runtime.context import Context
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import Messages

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
_MOMENTS: dict[Type, str] = {kinds.TIME: "II", kinds.DURATION: "ii"}
BILLION = 1_000_000_000


def struct_code(kind: Type) -> str | None:
    """The `struct` code of a type of fixed size (of times two: seconds and nanoseconds), None for others."""
    if isinstance(kind, kinds.Bool):
        return "?"
    if isinstance(kind, kinds.Integer):
        return _CODES[kind.signed, kind.bits]
    if isinstance(kind, kinds.Floating):
        return "f" if kind.bits == 32 else "d"
    return _MOMENTS.get(kind)


def struct_size(codes: str) -> int:
    """The bytes of values with these `struct` codes."""
    return sum({"?": 1, "b": 1, "h": 2, "i": 4, "q": 8, "f": 4, "d": 8}[code.lower()] for code in codes)


class Values:
    """The values of the types of a set of message definitions."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._measures: dict[Type, Callable[[Any], int]] = {}

    def fields(self, kind: kinds.Record) -> list[Type]:
        """The types of a message's fields, in order."""
        return [slot.type for slot in self._messages.slots(kind.name).values()]

    # Sizes

    def width(self, kind: Type) -> int:
        """The bytes that C++ takes for a value (without what a string or vector in it points to)."""
        if isinstance(kind, kinds.Integer | kinds.Floating):
            return kind.bits // 8
        if isinstance(kind, kinds.Record):
            return sum(map(self.width, self.fields(kind))) or 1
        if isinstance(kind, kinds.Vector) and kind.length is not None:
            return kind.length * self.width(kind.element)
        return 1 if isinstance(kind, kinds.Bool) else 8 if kind in (kinds.TIME, kinds.DURATION) else 32

    def least(self, kind: Type) -> int:
        """The bytes of the shortest value in a message."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, kinds.Record):
            return self._messages.definitions.layout(kind.name).minimum
        if isinstance(kind, kinds.Vector) and kind.length is not None:
            return kind.length * self.least(kind.element)
        return 4

    def measure(self, kind: Type) -> Callable[[Any], int]:
        """A function that says how many bytes a value holds."""
        if kind not in self._measures:
            self._measures[kind] = self._measure(kind)
        return self._measures[kind]

    def _measure(self, kind: Type) -> Callable[[Any], int]:
        if isinstance(kind, kinds.String | kinds.Characters):
            return len
        if isinstance(kind, kinds.Vector):
            width, inner = self.width(kind.element), self.measure(kind.element)
            if struct_code(kind.element):
                return lambda values: len(values) * width
            return lambda values: len(values) * width + sum(map(inner, values))
        if isinstance(kind, kinds.Record):
            large = [
                (index, self.measure(field))
                for index, field in enumerate(self.fields(kind))
                if not struct_code(field)
            ]
            own = self.width(kind)
            return lambda record: own + sum(measure(record[index]) for index, measure in large)
        return lambda _: 8

    # Zeros and copies

    def zero(self, kind: Type) -> Any:
        """A zero value, newly made; None of void."""
        if isinstance(kind, kinds.Bool):
            return False
        if isinstance(kind, kinds.Floating):
            return 0.0
        if isinstance(kind, kinds.Integer | kinds.Time | kinds.Duration):
            return 0
        if isinstance(kind, kinds.String | kinds.Characters):
            return b""
        if isinstance(kind, kinds.Vector):
            return [self.zero(kind.element) for _ in range(kind.length or 0)]
        return [self.zero(field) for field in self.fields(kind)] if isinstance(kind, kinds.Record) else None

    def copy(self, context: Context, kind: Type, value: Any, site: int) -> Any:
        """A copy with all that is in it, charged."""
        if isinstance(kind, kinds.Record):
            pairs = zip(self.fields(kind), value, strict=True)
            return [self.copy(context, field, part, site) for field, part in pairs]
        if not isinstance(kind, kinds.Vector):
            return value
        context.allocate(len(value) * self.width(kind.element), site)
        return [self.copy(context, kind.element, element, site) for element in value]

    # In a message

    def decode(self, kind: Type, buffer: wire.Buffer, start: int) -> tuple[Any, int]:
        """The value at `start`, and where it ends."""
        if isinstance(kind, kinds.String):
            return wire.text(buffer, start)
        if isinstance(kind, kinds.Record):
            record = []
            for field in self.fields(kind):
                value, start = self.decode(field, buffer, start)
                record.append(value)
            return record, start
        if isinstance(kind, kinds.Vector):
            return self._decode_vector(kind, buffer, start)
        code = struct_code(kind) or ""
        parts, end = struct.unpack_from(f"<{code}", buffer, start), start + struct_size(code)
        return (parts[0] * BILLION + parts[1] if len(parts) == 2 else parts[0]), end

    def _decode_vector(self, kind: kinds.Vector, buffer: wire.Buffer, start: int) -> tuple[list[Any], int]:
        number = kind.length
        if number is None:
            number = wire.count(buffer, start, self.least(kind.element))
            start += 4
        code = struct_code(kind.element)
        if code is None:
            return wire.elements(buffer, start, number, lambda b, p: self.decode(kind.element, b, p))
        if len(code) == 2:
            return wire.moments(buffer, start, number, code[0])
        return wire.numbers(buffer, start, number, code, struct_size(code))

    def encode(self, kind: Type, value: Any, out: bytearray) -> None:
        """Append the bytes of a value."""
        if isinstance(kind, kinds.String):
            wire.put_text(value, out)
        elif isinstance(kind, kinds.Record):
            for field, part in zip(self.fields(kind), value, strict=True):
                self.encode(field, part, out)
        elif isinstance(kind, kinds.Vector):
            if kind.length is None:
                out += struct.pack("<I", len(value))
            else:
                vectors.fixed(value, kind.length, -1)
            for element in value:
                self.encode(kind.element, element, out)
        else:
            code = struct_code(kind) or ""
            out += struct.pack(f"<{code}", *(divmod(value, BILLION) if len(code) == 2 else (value,)))
