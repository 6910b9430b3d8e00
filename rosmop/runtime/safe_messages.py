"""Compare safe messages with received ones, and stamp them for sending."""

import struct

from rosmop.form.nodes import SafeMessage

HEAD = 12

_STAMP = struct.Struct("<III")
_MOST_SECONDS = (1 << 32) - 1


def is_safe(safe: SafeMessage, buffer: bytes | bytearray | memoryview) -> bool:
    first = HEAD if safe.stamped else 0
    return len(buffer) == len(safe.data) and buffer[first:] == safe.data[first:]


def sent(safe: SafeMessage, time_ns: int) -> bytes:
    if not safe.stamped:
        return safe.data
    seconds, nanoseconds = divmod(max(0, time_ns), 1_000_000_000)
    return _STAMP.pack(0, min(seconds, _MOST_SECONDS), nanoseconds) + safe.data[HEAD:]
