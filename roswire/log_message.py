"""Encode messages of `rosgraph_msgs/Log`, which rqt_console displays."""

import struct

TYPE = "rosgraph_msgs/Log"
DEBUG, INFO, WARN, ERROR, FATAL = 1, 2, 4, 8, 16
_HEADER = struct.Struct("<III")
_LENGTH = struct.Struct("<I")


def log_message(
    sequence: int, time_ns: int, level: int, name: str, text: str, *, file: str, function: str
) -> bytes:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    fields = (name, text, file, function)
    return b"".join((
        _HEADER.pack(sequence & 0xFFFFFFFF, seconds & 0xFFFFFFFF, nanoseconds),
        _string(""),
        bytes([level]),
        *map(_string, fields),
        _LENGTH.pack(0),  # line
        _LENGTH.pack(0),  # number of topics
    ))  # fmt: skip


def _string(text: str) -> bytes:
    data = text.encode("utf-8", "replace")
    return _LENGTH.pack(len(data)) + data
