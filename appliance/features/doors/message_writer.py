"""Write plain values as serialised messages.

A schema of msgspec checks a whole message before anything is written, and names the path of the first error. As in
rosbridge, missing fields are zero; a header without a stamp, and a time that is `now`, get the present time.
"""

import binascii
import contextlib
import struct
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, Self

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from appliance.base.counted import counted
from appliance.features.doors.message_reader import BYTE_TYPES, TIME_TYPES, MessageValueError
from roswire.definitions import Definitions
from roswire.message_text import PRIMITIVES, Field, MessageDefinition

Now = tuple[int, int]
"""The present time: seconds and nanoseconds since the epoch."""

_Write = Callable[[Any, bytearray, Now], None]
_LENGTH = struct.Struct("<I")
_VALUE_BYTES = 100  # that a value takes at most besides its text: its place in a list, an empty list
_PART_BYTES = 1 << 16
_HEADER = "std_msgs/Header"


_Int8 = Annotated[int, Meta(ge=-(1 << 7), le=(1 << 7) - 1)]
_Uint8 = Annotated[int, Meta(ge=0, le=(1 << 8) - 1)]
_Int32 = Annotated[int, Meta(ge=-(1 << 31), le=(1 << 31) - 1)]
_Uint32 = Annotated[int, Meta(ge=0, le=(1 << 32) - 1)]
_SCALARS: dict[str, Any] = {
    "bool": bool,
    "string": str,
    "float32": float,
    "float64": float,
    "byte": _Int8,
    "char": _Uint8,
    "int8": _Int8,
    "uint8": _Uint8,
    "int16": Annotated[int, Meta(ge=-(1 << 15), le=(1 << 15) - 1)],
    "uint16": Annotated[int, Meta(ge=0, le=(1 << 16) - 1)],
    "int32": _Int32,
    "uint32": _Uint32,
    "int64": Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)],
    "uint64": Annotated[int, Meta(ge=0)],  # msgspec has no bound above int64: `struct` checks it
}


class _Time(Struct, forbid_unknown_fields=True):
    secs: _Uint32 | UnsetType = UNSET
    nsecs: _Uint32 | UnsetType = UNSET
    sec: _Uint32 | UnsetType = UNSET
    nanosec: _Uint32 | UnsetType = UNSET


class _Duration(Struct, forbid_unknown_fields=True):
    secs: _Int32 | UnsetType = UNSET
    nsecs: _Int32 | UnsetType = UNSET
    sec: _Int32 | UnsetType = UNSET
    nanosec: _Int32 | UnsetType = UNSET


class MessageWriter:
    """A writer of the messages of one type, each of at most `most_bytes`."""

    def __init__(self, definitions: Definitions, name: str, *, most_bytes: int) -> None:
        definitions.layout(name)  # raises if a type is missing, contains itself, or is too large
        self._name = name
        writers = _Writers(definitions, most_bytes)
        self._schema, self._write = writers.message(name)
        self._decoder = msgspec.json.Decoder(self._schema)
        self._most_bytes = most_bytes
        made = [(definitions.layout(one).minimum, definitions.message(one)) for one in writers.made]
        self._zero_bytes = max(minimum for minimum, _message in made)
        self._object_bytes = _VALUE_BYTES + 8 * max(len(message.fields) for _minimum, message in made)
        self.fields = [field.name for field in definitions.message(name).fields]

    def cost(self, text: bytes | msgspec.Raw) -> int:
        """Return an upper bound of the bytes that `from_json` takes at once."""
        view = memoryview(text)
        parts = (bytes(view[start : start + _PART_BYTES]) for start in range(0, len(view), _PART_BYTES))
        objects = others = 0
        for part in parts:
            objects += part.count(b"{")
            others += part.count(b",") + part.count(b"[")
        zeros = min(objects * self._zero_bytes, self._most_bytes)
        return len(view) * 17 // 4 + objects * self._object_bytes + others * _VALUE_BYTES + 2 * zeros

    def from_json(self, text: bytes | msgspec.Raw, now: Now) -> bytes:
        out = bytearray()
        try:
            self._write(self._decoder.decode(text), out, now)
        except (ValueError, RecursionError) as error:  # of msgspec
            raise MessageValueError(f"{self._name}: {error}") from None
        except _FieldError as error:
            raise MessageValueError(f"{self._name}: {error.text} - at `${error.path}`") from None
        return bytes(out)


class _FieldError(Exception):
    """A value that its schema accepts but that cannot be written; `path` leads to it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text
        self.path = ""

    def inside(self, step: str) -> Self:
        self.path = step + self.path
        return self


class _Writers:
    def __init__(self, definitions: Definitions, most_bytes: int) -> None:
        self._definitions = definitions
        self._most_bytes = most_bytes
        self.made: dict[str, tuple[type[Struct], _Write]] = {}

    def message(self, name: str) -> tuple[type[Struct], _Write]:
        if name not in self.made:
            self.made[name] = self._message(self._definitions.message(name))
        return self.made[name]

    def _message(self, message: MessageDefinition) -> tuple[type[Struct], _Write]:
        parts: list[tuple[str, _Write, int]] = []
        schema: list[tuple[str, Any, Any]] = []
        for number, field in enumerate(message.fields):
            kind, write_field = self._field(field)
            # Python's keywords may be names of fields, so the schema has names of its own.
            schema.append((f"f{number}", kind | UnsetType, UNSET))
            parts.append((field.name, write_field, self._zeros(field)))
        encoded = {f"f{number}": field.name for number, field in enumerate(message.fields)}
        struct_type = msgspec.defstruct(
            message.name.replace("/", "_"), schema, rename=encoded, forbid_unknown_fields=True
        )
        stamped = message.name == _HEADER

        def write(value: Any, out: bytearray, now: Now) -> None:
            for (name, write_part, zeros), given in zip(parts, msgspec.structs.astuple(value), strict=True):
                try:
                    if given is UNSET and stamped and name == "stamp":
                        write_part("now", out, now)
                    elif given is UNSET:
                        self._check_room(out, zeros)
                        out += bytes(zeros)
                    else:
                        write_part(given, out, now)
                except (struct.error, OverflowError):
                    raise _FieldError("Number out of range").inside(f".{name}") from None
                except _FieldError as error:
                    raise error.inside(f".{name}") from None

        return struct_type, write

    def _field(self, field: Field) -> tuple[Any, _Write]:
        if not field.is_array:
            return self._element(field.type)
        if field.type in BYTE_TYPES:
            return str | list[_Uint8], self._bytes(field)
        kind, write = self._element(field.type)
        if field.type in PRIMITIVES and field.type not in TIME_TYPES:
            code, size = PRIMITIVES[field.type]
            return list[kind], self._counted(  # type: ignore[valid-type]  # a schema that was made
                field, lambda values: struct.pack(f"<{len(values)}{code}", *values), size
            )
        return list[kind], self._elements(field, write)  # type: ignore[valid-type]  # a schema that was made

    def _element(self, kind: str) -> tuple[Any, _Write]:
        if kind == "string":
            return str, self._string
        if kind in TIME_TYPES:
            return _time(kind)
        if kind in PRIMITIVES:
            whole = struct.Struct("<" + PRIMITIVES[kind][0])
            return _SCALARS[kind], lambda value, out, _now: out.extend(whole.pack(value))
        return self.message(kind)

    def _string(self, value: str, out: bytearray, _now: Now) -> None:
        data = value.encode()
        self._check_room(out, len(data))
        out += _LENGTH.pack(len(data))
        out += data

    def _bytes(self, field: Field) -> _Write:
        write_bytes = self._counted(field, bytes, 1)

        def write(value: object, out: bytearray, now: Now) -> None:
            write_bytes(_of_base64(value) if isinstance(value, str) else value, out, now)

        return write

    def _counted(self, field: Field, pack: Callable[[Any], bytes], size: int) -> _Write:
        def write(values: Sequence[Any], out: bytearray, _now: Now) -> None:
            self._check_room(out, len(values) * size)
            _write_count(field, len(values), out)
            out += pack(values)

        return write

    def _elements(self, field: Field, write_element: _Write) -> _Write:
        def write(values: Sequence[Any], out: bytearray, now: Now) -> None:
            _write_count(field, len(values), out)
            for number, value in enumerate(values):
                self._check_room(out, 0)
                try:
                    write_element(value, out, now)
                except _FieldError as error:
                    raise error.inside(f"[{number}]") from None

        return write

    def _check_room(self, out: bytearray, size: int) -> None:
        if len(out) + size > self._most_bytes:
            raise _FieldError(f"The message has more than {self._most_bytes} bytes")

    def _zeros(self, field: Field) -> int:
        if field.is_array and field.length is None:
            return 4
        if field.type == "string":
            size = 4
        elif field.type in PRIMITIVES:
            size = PRIMITIVES[field.type][1]
        else:
            size = self._definitions.layout(field.type).minimum
        return size * (1 if field.length is None else field.length)


def _time(kind: str) -> tuple[Any, _Write]:
    whole = struct.Struct("<" + PRIMITIVES[kind][0])

    def write(value: Any, out: bytearray, now: Now) -> None:
        if value == "now":
            out += whole.pack(*now)
            return
        secs = value.sec if value.secs is UNSET else value.secs
        nsecs = value.nanosec if value.nsecs is UNSET else value.nsecs
        whole_seconds, rest = divmod(0 if nsecs is UNSET else nsecs, 1_000_000_000)  # as ROS does
        out += whole.pack((0 if secs is UNSET else secs) + whole_seconds, rest)

    return (_Time | Literal["now"] if kind == "time" else _Duration), write


def _of_base64(text: str) -> bytes:
    """Return the bytes of a text, which may have lines, as from MIME and from Android."""
    with contextlib.suppress(ValueError):
        if text.isascii():  # otherwise, each copy could take four bytes for a character
            return binascii.a2b_base64(text.replace("\n", "").replace("\r", ""), strict_mode=True)
    raise _FieldError("Invalid base64 encoded string")


def _write_count(field: Field, count: int, out: bytearray) -> None:
    if field.length is None:
        out += _LENGTH.pack(count)
    elif count != field.length:
        raise _FieldError(f"Expected {field.notation}, got {counted(count, 'element')}")
