"""Display a message within limits. Bytes that are cut off or malicious are displayed as far as they are readable.

`…` replaces an unreadable value, and a note such as `… 344 more` the rest of a long one.
"""

import hashlib
import math
import struct
from collections.abc import Mapping
from itertools import islice
from typing import Any

from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import PRIMITIVES

MAX_ELEMENTS = 16
MAX_CHARACTERS = 200
MAX_BYTES = 32
MAX_FIELDS = 200
_MAX_STEPS = 2_000
CUT = "…"

_LENGTH = struct.Struct("<I")
_OF_NOTHING = hashlib.md5(b"", usedforsecurity=False).hexdigest()  # the md5sum of std_msgs/Empty


class _EndError(Exception):
    """The bytes end here, or a limit is reached."""


class _Reader:
    def __init__(self, definitions: Definitions, data: bytes) -> None:
        self._definitions = definitions
        self._data = data
        self.position = 0
        self._left = MAX_FIELDS  # the number of values that may still be shown
        self._steps = _MAX_STEPS  # the number of values that may still be read, whether shown or not
        self._sizes: dict[str, int | None] = {}

    def message(self, name: str) -> dict[str, object]:
        fields: dict[str, object] = {}
        following = iter(self._definitions.message(name).fields)
        for field in following:
            try:
                fields[field.name] = (
                    self._array(field.type, field.length) if field.is_array else self._value(field.type)
                )
            except (_EndError, _CutError) as end:
                fields[field.name] = end.value if isinstance(end, _CutError) else CUT
                fields |= {after.name: CUT for after in islice(following, MAX_FIELDS)}
                if unnamed := sum(1 for _ in following):
                    fields[CUT] = _more(unnamed)
                raise _CutError(fields) from None
        return fields

    def _array(self, kind: str, length: int | None) -> object:
        count = length if length is not None else _LENGTH.unpack(self._take(4))[0]
        if kind in {"uint8", "char"}:
            return read_bytes(self._take(count))
        values: list[object] = []
        for _ in range(min(count, MAX_ELEMENTS)):
            try:
                values.append(self._value(kind))
            except (_EndError, _CutError) as end:
                raise _CutError([*values, end.value if isinstance(end, _CutError) else CUT]) from None
        if count <= MAX_ELEMENTS:
            return values
        values.append(_more(count - MAX_ELEMENTS))
        try:
            self._pass_over(kind, count - MAX_ELEMENTS)
        except (_EndError, _CutError):
            raise _CutError(values) from None
        return values

    def _pass_over(self, kind: str, count: int) -> None:
        size = self._size(kind)
        if size is not None:
            self._take(size * count)
            return
        left, self._left = self._left, _MAX_STEPS
        for _ in range(count):
            self._value(kind)
        self._left = left

    def _size(self, kind: str) -> int | None:
        if kind in PRIMITIVES:
            return PRIMITIVES[kind][1]
        if kind == "string":
            return None
        if kind not in self._sizes:
            size: int | None = 0
            for field in self._definitions.message(kind).fields:
                inner = self._size(field.type)
                if size is None or inner is None or (field.is_array and field.length is None):
                    size = None
                else:
                    size += inner * (field.length if field.is_array and field.length is not None else 1)
            self._sizes[kind] = size
        return self._sizes[kind]

    def _value(self, kind: str) -> object:
        self._left -= 1
        self._steps -= 1
        if self._left < 0 or self._steps < 0:
            raise _EndError
        if kind == "string":
            raw = self._take(_LENGTH.unpack(self._take(4))[0])
            text = raw[:MAX_CHARACTERS].decode("utf-8", "backslashreplace")
            return text + _more(len(raw) - MAX_CHARACTERS)
        if kind not in PRIMITIVES:
            return self.message(kind)
        code, size = PRIMITIVES[kind]
        values = struct.unpack(f"<{code}", self._take(size))
        if len(values) == 2:
            return round(values[0] + values[1] / 1e9, 9)
        value = values[0]
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value

    def _take(self, size: int) -> bytes:
        data = self._data[self.position : self.position + size]
        if len(data) < size:
            raise _EndError
        self.position += size
        return data


class _CutError(Exception):
    """The bytes end inside a value. `value` is the part that was read."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


def read_bytes(data: bytes) -> str:
    return data[:MAX_BYTES].hex() + _more(len(data) - MAX_BYTES)


def _more(count: int) -> str:
    return f"{CUT} {count} more" if count > 0 else ""


def read_fields(definitions: Definitions, name: str, data: bytes) -> dict[str, Any] | None:
    try:
        definitions.md5sum(name)  # raises if a type is missing, contains itself, or is nested too deep
        return _Reader(definitions, data).message(name)
    except _CutError as cut:
        fields: dict[str, Any] = cut.value
        return fields
    except DefinitionError:
        return None


def rest_of(definitions: Definitions, name: str, data: bytes) -> bytes:
    """Return the bytes behind the last field of a message; none if the message is cut or cannot be read."""
    reader = _Reader(definitions, data)
    try:
        definitions.md5sum(name)
        reader.message(name)
    except (_CutError, DefinitionError):
        return b""
    return data[reader.position :]


class PublisherReader:
    """Reads messages with the definition in the publisher's connection header."""

    def __init__(self, header: Mapping[str, str]) -> None:
        self.type = header.get("type", "")
        self._definitions: Definitions | None = None
        self._why = ""
        try:
            self._definitions = _definitions(self.type, header)
        except DefinitionError as error:
            self._why = f": {str(error)[:300]}"

    def read(self, data: bytes) -> tuple[dict[str, Any], str]:
        """Return the fields and "". Without a usable definition, return the first bytes and the reason."""
        fields = read_fields(self._definitions, self.type, data) if self._definitions is not None else None
        if fields is not None:
            return fields, ""
        why = f"the definition in the publisher's header cannot be read{self._why}"
        return {"data": read_bytes(data)}, why


def _definitions(kind: str, header: Mapping[str, str]) -> Definitions:
    text = header.get("message_definition", "")
    if not text.strip() and header.get("md5sum") != _OF_NOTHING:
        raise DefinitionError("there is none", kind[:200])
    definitions = Definitions.from_full_text(kind, text)
    definitions.md5sum(kind)  # raises if a type cannot be used
    return definitions
