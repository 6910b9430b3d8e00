"""Compare safe messages with received ones, and stamp them for sending."""

import struct

from rosmop.form.nodes import SafeMessage

HEAD = 12

_LENGTH = struct.Struct("<I")
_STAMP = struct.Struct("<III")
_MAX_SECONDS = (1 << 32) - 1


def is_safe(safe: SafeMessage, buffer: bytes | bytearray | memoryview) -> bool:
    """Whether a message is the safe one, but for its stamp, and but for its frame if all that follows is zero."""
    if not safe.stamped:
        return bytes(buffer) == safe.data
    if len(buffer) < HEAD + _LENGTH.size:
        return False
    frame, body = _behind_stamp(buffer)
    safe_frame, safe_body = _behind_stamp(safe.data)
    return body == safe_body and (frame == safe_frame or not any(body))


def _behind_stamp(buffer: bytes | bytearray | memoryview) -> tuple[bytes, bytes]:
    first = HEAD + _LENGTH.size
    end = first + _LENGTH.unpack_from(buffer, HEAD)[0]
    return bytes(buffer[first:end]), bytes(buffer[end:])


def to_bytes(safe: SafeMessage, time_ns: int) -> bytes:
    if not safe.stamped:
        return safe.data
    seconds, nanoseconds = divmod(max(0, time_ns), 1_000_000_000)
    return _STAMP.pack(0, min(seconds, _MAX_SECONDS), nanoseconds) + safe.data[HEAD:]
