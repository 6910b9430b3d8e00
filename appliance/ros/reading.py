"""A message as fields and values, for people: as far as its bytes go, and within bounds.

What cannot be read is left out and said (`…`): the bytes may be cut off, or a stranger's. Long strings, arrays and
messages are shortened; the result is plain values that a log can hold.
"""

import math
import struct
from typing import Any

from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.message_text import PRIMITIVES

MOST_ELEMENTS = 16
MOST_CHARACTERS = 200
MOST_FIELDS = 200
CUT = "…"

_LENGTH = struct.Struct("<I")


class _EndError(Exception):
    """There are no more bytes, or enough has been read."""


class _Reader:
    def __init__(self, definitions: Definitions, data: bytes) -> None:
        self._definitions = definitions
        self._data = data
        self._position = 0
        self._left = MOST_FIELDS

    def message(self, name: str) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for field in self._definitions.message(name).fields:
            try:
                fields[field.name] = (
                    self._array(field.type, field.length) if field.is_array else self._value(field.type)
                )
            except _EndError:
                fields[field.name] = CUT
                raise _CutError(fields) from None
            except _CutError as cut:
                fields[field.name] = cut.value
                raise _CutError(fields) from None
        return fields

    def _array(self, kind: str, length: int | None) -> Any:
        count = length if length is not None else _LENGTH.unpack(self._take(4))[0]
        if kind in {"uint8", "char"}:
            return self._take(count)[:MOST_CHARACTERS].hex()
        values: list[Any] = []
        for _ in range(count):
            try:
                value = self._value(kind)
            except _EndError:
                raise _CutError([*values[:MOST_ELEMENTS], CUT]) from None
            except _CutError as cut:
                raise _CutError([*values[:MOST_ELEMENTS], cut.value]) from None
            if len(values) <= MOST_ELEMENTS:
                values.append(value)
        return [*values[:MOST_ELEMENTS], CUT] if count > MOST_ELEMENTS else values

    def _value(self, kind: str) -> Any:
        self._left -= 1
        if self._left < 0:
            raise _EndError
        if kind == "string":
            raw = self._take(_LENGTH.unpack(self._take(4))[0])
            text = raw[:MOST_CHARACTERS].decode("utf-8", "backslashreplace")
            return text + CUT if len(raw) > MOST_CHARACTERS else text
        if kind not in PRIMITIVES:
            return self.message(kind)
        code, size = PRIMITIVES[kind]
        values = struct.unpack(f"<{code}", self._take(size))
        if len(values) == 2:
            return round(values[0] + values[1] / 1e9, 9)
        value = values[0]
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value

    def _take(self, size: int) -> bytes:
        data = self._data[self._position : self._position + size]
        if len(data) < size:
            raise _EndError
        self._position += size
        return data


class _CutError(Exception):
    """The end came inside a value; `value` is what there was of it."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


def read_fields(definitions: Definitions, name: str, data: bytes) -> dict[str, Any] | None:
    """The fields of a message of the type `name` as far as `data` goes; None if the type is not known."""
    try:
        return _Reader(definitions, data).message(name)
    except _CutError as cut:
        fields: dict[str, Any] = cut.value
        return fields
    except DefinitionError:
        return None
