"""TCPROS without I/O: connection headers, message frames and service replies.

Each side sends a header: a length, then fields `name=value`, each with its own length. Frames follow: a length and a
body. In a service reply, one byte precedes the frame: 1, or 0 if the body is an error message. All lengths are 32-bit
little-endian. Invariants:

1. The length of a frame, header or field is checked before any of its bytes are stored.
2. In an accepted header, each field has a name and occurs once.
3. Header text is UTF-8. Only `message_definition` may have other bytes, because roscpp copies comments unchanged;
   they survive decoding and encoding as surrogate escapes.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from roswire.errors import LimitExceededError, ProtocolError

HEADER_LIMIT = 65536
"""The largest message definitions of MoveIt need about half of this."""

MESSAGE_LIMIT = 256 << 20

Body: TypeAlias = bytes | bytearray
"""A message in bytes. All receivers share it, so they must not change it."""

_LENGTH = struct.Struct("<I")
_ANY_BYTES = frozenset({"message_definition"})


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Return a header, including its length."""
    lines = [f"{name}={value}".encode("utf-8", "surrogateescape") for name, value in fields.items()]
    body = b"".join([_LENGTH.pack(len(line)) + line for line in lines])
    return _LENGTH.pack(len(body)) + body


def encode_frame(body: bytes | bytearray | memoryview) -> bytes:
    return _LENGTH.pack(len(body)) + body


def encode_service_reply(body: bytes | bytearray | memoryview) -> bytes:
    return b"\x01" + encode_frame(body)


def encode_service_error(text: str) -> bytes:
    return b"\x00" + encode_frame(text.encode("utf-8", "replace"))


def decode_header(body: bytes) -> dict[str, str]:
    """Parse the body of a header, without its length. Raise `ProtocolError`."""
    fields: dict[str, str] = {}
    position = 0
    while position < len(body):
        if len(body) - position < _LENGTH.size:
            raise ProtocolError(
                f"connection header: {len(body) - position} bytes left over at byte {position}"
            )
        (size,) = _LENGTH.unpack_from(body, position)
        position += _LENGTH.size
        if size > len(body) - position:
            raise ProtocolError(
                f"connection header: the field at byte {position} says {size} bytes; "
                f"{len(body) - position} are left"
            )
        name, value = _decode_field(body[position : position + size], position)
        if name in fields:
            raise ProtocolError(f"connection header: field {name!a} occurs twice")
        fields[name] = value
        position += size
    return fields


class HeaderParser:
    """Parses a header. Bytes that follow it are in `rest`."""

    def __init__(self, limit: int = HEADER_LIMIT) -> None:
        self.rest = b""
        self._limit = limit
        self._buffer = bytearray()
        self._done = False

    def feed(self, data: bytes) -> dict[str, str] | None:
        """Take bytes, and return the header once it is complete.

        Raise `LimitExceededError` as soon as the announced length exceeds the limit, `ProtocolError` for a malformed
        header, and RuntimeError after the header was returned.
        """
        if self._done:
            raise RuntimeError("the header is complete; what followed it is in .rest")
        buffer = self._buffer
        buffer += data
        if len(buffer) < _LENGTH.size:
            return None
        (size,) = _LENGTH.unpack_from(buffer)
        if size > self._limit:
            raise LimitExceededError(
                f"connection header of {size} bytes; at most {self._limit} are allowed "
                "(is this a TCPROS peer?)"
            )
        end = _LENGTH.size + size
        if len(buffer) < end:
            return None
        self._done = True
        self.rest = bytes(buffer[end:])
        fields = decode_header(bytes(buffer[_LENGTH.size : end]))
        self._buffer = bytearray()
        return fields


class FrameParser:
    """Parses frames of at most `limit` bytes."""

    def __init__(self, limit: int = MESSAGE_LIMIT) -> None:
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes, and return the bodies that are now complete. Raise `LimitExceededError`."""
        buffer = self._buffer
        buffer += data
        frames = []
        position = 0
        while len(buffer) - position >= _LENGTH.size:
            (size,) = _LENGTH.unpack_from(buffer, position)
            _check_frame(size, self._limit)
            end = position + _LENGTH.size + size
            if len(buffer) < end:
                break
            frames.append(bytes(buffer[position + _LENGTH.size : end]))
            position = end
        del buffer[:position]
        return frames


@dataclass(frozen=True, slots=True)
class ServiceReply:
    """A reply. `body` is the serialised response, or an error message."""

    ok: bool
    body: bytes


class ServiceReplyParser:
    """Parses replies of at most `limit` bytes."""

    def __init__(self, limit: int = MESSAGE_LIMIT) -> None:
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[ServiceReply]:
        """Take bytes, and return the replies that are now complete.

        Raise `ProtocolError` if the first byte is neither 0 nor 1, and `LimitExceededError`.
        """
        buffer = self._buffer
        buffer += data
        replies = []
        position = 0
        while position < len(buffer):
            ok = buffer[position]
            if ok > 1:
                raise ProtocolError(f"service reply: the first byte is {ok}; it is 1 (success) or 0 (error)")
            start = position + 1 + _LENGTH.size
            if len(buffer) < start:
                break
            (size,) = _LENGTH.unpack_from(buffer, position + 1)
            _check_frame(size, self._limit)
            if len(buffer) < start + size:
                break
            replies.append(ServiceReply(ok == 1, bytes(buffer[start : start + size])))
            position = start + size
        del buffer[:position]
        return replies


def _check_frame(size: int, limit: int) -> None:
    if size > limit:
        raise LimitExceededError(f"frame of {size} bytes; at most {limit} are allowed")


def _decode_field(field: bytes, position: int) -> tuple[str, str]:
    raw_name, equals, raw_value = field.partition(b"=")
    if not equals:
        raise ProtocolError(f"connection header: the field at byte {position} has no '=': {field[:40]!r}")
    try:
        name = raw_name.decode("ascii")
    except UnicodeDecodeError:
        name = ""
    if not name or not name.isprintable() or name != name.strip():
        raise ProtocolError(
            f"connection header: the field at byte {position} has no valid name: {raw_name[:40]!r}"
        )
    try:
        return name, raw_value.decode("utf-8", "surrogateescape" if name in _ANY_BYTES else "strict")
    except UnicodeDecodeError as error:
        raise ProtocolError(
            f"connection header: field {name!a} is not UTF-8 (byte {error.start} of its value)"
        ) from None
