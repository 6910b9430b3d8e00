"""Read the values of a message's fields by path, as far as they are useful for learning.

Numbers, strings and times are scalars, arrays of numbers are tuples, arrays of strings are lists, and arrays
of messages have only their length. Single bytes (of images, points, maps) mean nothing, and every publisher
increments the `seq` of headers, so both are left out.
"""

import struct
from collections.abc import Callable, Iterator

from roswire.message_layout import ArrayPart, FixedField, FixedPart, MessageLayout, StringPart
from roswire.message_text import PRIMITIVES

MAX_ELEMENTS = 20_000
"""The longest array whose elements are read: a monitor that reads a longer array would be too slow."""

_LENGTH = struct.Struct("<I")
_BYTES = frozenset({"uint8", "int8", "char", "byte", "bool"})
_NO_NUMBERS = frozenset({"time", "duration"})

Value = float | str | bytes | tuple[float, ...] | list[str | bytes]
"""A tuple is an array of numbers, or seconds and nanoseconds; a list is an array of strings."""
_Part = Callable[[bytes, int, dict[str, Value]], int]


class MessageError(Exception):
    """The bytes of a message do not fit its type."""


class Fields:
    """Reads the messages of one type."""

    def __init__(self, layout: MessageLayout) -> None:
        self._parts = [_reader(part) for part in layout.parts]
        self.types = dict(_types(layout))
        """The primitive types of the fields that are read, `[]` for arrays; `length` if only the length is read."""

    def read(self, data: bytes) -> dict[str, Value]:
        values: dict[str, Value] = {}
        position = 0
        try:
            for part in self._parts:
                position = part(data, position, values)
        except (struct.error, ValueError) as error:
            raise MessageError(str(error)) from error
        return values


def _wanted(path: str) -> bool:
    return path != "header.seq" and not path.endswith(".header.seq")


def _types(layout: MessageLayout) -> Iterator[tuple[str, str]]:
    for part in layout.parts:
        for item in part.leaves if isinstance(part, FixedPart) else (part,):
            if isinstance(item, StringPart):
                yield item.path, "string"
            elif isinstance(item, FixedField) and item.count is None:
                if _wanted(item.path):
                    yield item.path, item.type
            elif _elements_read(item):
                yield item.path, f"{item.type}[]"
            elif isinstance(item, ArrayPart):
                yield item.path, "length"


def _elements_read(item: FixedField | ArrayPart) -> bool:
    return item.layout is None and item.type not in _BYTES | _NO_NUMBERS


def _reader(part: FixedPart | StringPart | ArrayPart) -> _Part:
    if isinstance(part, FixedPart):
        return _fixed(part)
    if isinstance(part, StringPart):

        def text(data: bytes, position: int, values: dict[str, Value]) -> int:
            end, values[part.path] = _string(data, position)
            return end

        return text
    return _array(part)


def _fixed(part: FixedPart) -> _Part:
    scalars = [leaf for leaf in part.leaves if leaf.count is None and _wanted(leaf.path)]
    arrays = [
        (leaf.path, leaf.offset, struct.Struct(f"<{leaf.count}{PRIMITIVES[leaf.type][0]}"))
        for leaf in part.leaves
        if leaf.count is not None and leaf.count <= MAX_ELEMENTS and _elements_read(leaf)
    ]
    chosen = {leaf.path for leaf in scalars}
    code = "<" + "".join(
        PRIMITIVES[leaf.type][0] if leaf.path in chosen else f"{leaf.size}x" for leaf in part.leaves
    )
    unpack = struct.Struct(code).unpack_from
    times = [leaf.type in _NO_NUMBERS for leaf in scalars]

    def read(data: bytes, position: int, values: dict[str, Value]) -> int:
        found = iter(unpack(data, position))
        for leaf, is_time in zip(scalars, times, strict=True):
            values[leaf.path] = (next(found), next(found)) if is_time else next(found)
        for path, offset, layout in arrays:
            values[path] = layout.unpack_from(data, position + offset)
        return position + part.size

    return read


def _array(part: ArrayPart) -> _Part:
    kind = PRIMITIVES[part.type][0] if _elements_read(part) and part.type != "string" else None
    nested = [_reader(inner) for inner in part.layout.parts] if part.layout is not None else []

    def read(data: bytes, position: int, values: dict[str, Value]) -> int:
        count = part.count
        if count is None:
            (count,) = _LENGTH.unpack_from(data, position)
            position += 4
        if part.type == "string":
            texts = []
            for _ in range(count):
                position, text = _string(data, position)
                texts.append(text)
            values[part.path] = texts
            return position
        read_elements = kind is not None and count <= MAX_ELEMENTS
        values[part.path] = struct.unpack_from(f"<{count}{kind}", data, position) if read_elements else count
        if part.element_size is not None:
            return _within(data, position + count * part.element_size)
        for _ in range(count):
            ignored: dict[str, Value] = {}
            for inner in nested:
                position = inner(data, position, ignored)
        return position

    return read


def _string(data: bytes, position: int) -> tuple[int, str | bytes]:
    (length,) = _LENGTH.unpack_from(data, position)
    start = position + 4
    end = _within(data, start + length)
    text = data[start:end]
    try:
        return end, text.decode("utf-8")
    except UnicodeDecodeError:
        return end, text


def _within(data: bytes, position: int) -> int:
    if position > len(data):
        raise ValueError("it ends too early")
    return position
