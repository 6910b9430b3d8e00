"""Read serialised messages as plain values, which JSON and CBOR can write.

For CBOR, numeric arrays become typed arrays (RFC 8746), which are the bytes of the message itself. Each read has
a budget of values, because a small message can have very many, such as empty strings.
"""

import struct
from collections.abc import Callable

import cbor2

from roswire.definitions import Definitions
from roswire.errors import PeerError
from roswire.message_text import PRIMITIVES, Field
from roswire.tcpros import Body

TYPED_ARRAY_TAGS = {
    "uint16": 69, "uint32": 70, "uint64": 71, "byte": 72, "int8": 72, "int16": 77, "int32": 78, "int64": 79,
    "float32": 85, "float64": 86,
}  # fmt: skip
"""The tags of little-endian typed arrays, by the types of their elements."""

BYTE_TYPES = frozenset({"uint8", "char"})
"""Types whose arrays are bytes."""

TIME_TYPES = frozenset({"time", "duration"})
_COST_OF_OBJECT = 8  # values of an array for which an object takes the same memory
_LENGTH = struct.Struct("<I")


class MessageValueError(PeerError):
    """Values that do not fit their message type, or a message that does not fit its definition."""


class _Cursor:
    """The position, and the number of values that may still be read."""

    __slots__ = ("data", "left", "position")

    def __init__(self, data: Body, left: int) -> None:
        self.data = data
        self.position = 0
        self.left = left

    def take(self, size: int) -> Body:
        end = self.position + size
        if end > len(self.data):
            raise MessageValueError(
                f"cannot read {size} bytes at byte {self.position} of a message of {len(self.data)} bytes"
            )
        piece = self.data[self.position : end]
        self.position = end
        return piece

    def charge(self, values: int) -> None:
        self.left -= values
        if self.left < 0:
            raise MessageValueError("the message has too many values for JSON; subscribe with cbor-raw")

    def count(self) -> int:
        return int(_LENGTH.unpack(self.take(4))[0])


_Read = Callable[[_Cursor], object]
_ReadObject = Callable[[_Cursor], dict[str, object]]
_ReadInto = Callable[[_Cursor, dict[str, object]], None]


class MessageReader:
    """A reader of the messages of one type; `most_values` is the budget of one message."""

    def __init__(self, definitions: Definitions, name: str, *, typed_arrays: bool, most_values: int) -> None:
        definitions.layout(name)  # raises if a type is missing, contains itself, or is too large
        self._name = name
        self._most_values = most_values
        self._read = _Readers(definitions, typed_arrays=typed_arrays).message(name)

    def read(self, data: Body) -> dict[str, object]:
        cursor = _Cursor(data, self._most_values)
        try:
            values = self._read(cursor)
        except struct.error:
            raise MessageValueError(f"{self._name}: the message ends inside a field") from None
        except MessageValueError as error:
            raise MessageValueError(f"{self._name}: {error}") from None
        if cursor.position != len(data):
            raise MessageValueError(
                f"{self._name}: a message of {len(data)} bytes, of which its definition describes {cursor.position}"
            )
        return values


class _Readers:
    def __init__(self, definitions: Definitions, *, typed_arrays: bool) -> None:
        self._definitions = definitions
        self._typed_arrays = typed_arrays
        self._made: dict[str, _ReadObject] = {}

    def message(self, name: str) -> _ReadObject:
        if name not in self._made:
            self._made[name] = self._message(name)
        return self._made[name]

    def _message(self, name: str) -> _ReadObject:
        parts: list[_ReadInto] = []
        scalars: list[Field] = []
        fields = self._definitions.message(name).fields
        for field in fields:
            if field.type in PRIMITIVES and field.type not in TIME_TYPES and not field.is_array:
                scalars.append(field)
                continue
            if scalars:
                parts.append(_scalars(scalars))
                scalars = []
            parts.append(_one(field.name, self._field(field)))
        if scalars:
            parts.append(_scalars(scalars))
        cost = _COST_OF_OBJECT + len(fields)

        def read(cursor: _Cursor) -> dict[str, object]:
            cursor.charge(cost)
            values: dict[str, object] = {}
            for part in parts:
                part(cursor, values)
            return values

        return read

    def _field(self, field: Field) -> _Read:
        if not field.is_array:
            return self._element(field.type)
        if field.type in BYTE_TYPES:
            return lambda cursor: cursor.take(cursor.count() if field.length is None else field.length)
        if self._typed_arrays and field.type in TYPED_ARRAY_TAGS:
            return _typed_array(field)
        if field.type in PRIMITIVES and field.type not in TIME_TYPES:
            return _numbers(field)
        element = self._element(field.type)

        def read(cursor: _Cursor) -> list[object]:
            count = cursor.count() if field.length is None else field.length
            cursor.charge(count)
            return [element(cursor) for _ in range(count)]

        return read

    def _element(self, kind: str) -> _Read:
        if kind == "string":
            return _text
        if kind in TIME_TYPES:
            return _time(kind)
        return self.message(kind)


def _one(name: str, read: _Read) -> _ReadInto:
    def read_into(cursor: _Cursor, values: dict[str, object]) -> None:
        values[name] = read(cursor)

    return read_into


def _scalars(fields: list[Field]) -> _ReadInto:
    whole = struct.Struct("<" + "".join(PRIMITIVES[field.type][0] for field in fields))
    names = [field.name for field in fields]

    def read_into(cursor: _Cursor, values: dict[str, object]) -> None:
        values.update(zip(names, whole.unpack_from(cursor.data, cursor.position), strict=True))
        cursor.position += whole.size

    return read_into


def _text(cursor: _Cursor) -> str:
    text = cursor.take(cursor.count())
    cursor.charge(len(text) // 8)  # JSON writes up to six bytes for one
    return text.decode("utf-8", "replace")


def _time(kind: str) -> _Read:
    whole = struct.Struct("<" + PRIMITIVES[kind][0])

    def read(cursor: _Cursor) -> dict[str, int]:
        cursor.charge(_COST_OF_OBJECT)
        secs, nsecs = whole.unpack(cursor.take(whole.size))
        return {"secs": secs, "nsecs": nsecs}

    return read


def _typed_array(field: Field) -> _Read:
    tag, size = TYPED_ARRAY_TAGS[field.type], PRIMITIVES[field.type][1]
    return lambda cursor: cbor2.CBORTag(
        tag, cursor.take(size * (cursor.count() if field.length is None else field.length))
    )


def _numbers(field: Field) -> _Read:
    code, size = PRIMITIVES[field.type]

    def read(cursor: _Cursor) -> list[object]:
        count = cursor.count() if field.length is None else field.length
        data = cursor.take(count * size)
        cursor.charge(len(data) // 8)
        return [*struct.unpack(f"<{count}{code}", data)]

    return read
