"""Encode WebSocket frames for clients: final and not masked (RFC 6455, section 5.2).

Clients that get the same message share its frame. The frame of a large body is a pair of head and body, so the body
is not copied.
"""

import struct
from typing import TypeAlias

from roswire.tcpros import Body

ClientFrame: TypeAlias = bytes | tuple[bytes, Body]

_TEXT, _BINARY = 0x81, 0x82
_JOINED_BYTES = 1 << 15
_HEAD_BYTES = {126: 4, 127: 10}  # by the second byte, which otherwise is the length
_MIDDLE, _LARGE = struct.Struct(">BBH"), struct.Struct(">BBQ")


def text_frame(text: Body) -> ClientFrame:
    """Return a text frame; `text` is UTF-8."""
    return _frame(_TEXT, b"", text)


def binary_frame(head: bytes, body: Body = b"") -> ClientFrame:
    return _frame(_BINARY, head, body)


def _frame(first: int, head: bytes, body: Body) -> ClientFrame:
    length = len(head) + len(body)
    if length < 126:
        start = bytes((first, length))
    elif length < 1 << 16:
        start = _MIDDLE.pack(first, 126, length)
    else:
        start = _LARGE.pack(first, 127, length)
    return b"".join((start, head, body)) if length <= _JOINED_BYTES else (start + head, body)


def frame_size(frame: ClientFrame) -> int:
    return len(frame) if isinstance(frame, bytes) else len(frame[0]) + len(frame[1])


def is_text(frame: ClientFrame) -> bool:
    return _join(frame)[0] == _TEXT


def content(frame: ClientFrame) -> bytes:
    data = _join(frame)
    return data[_HEAD_BYTES.get(data[1], 2) :]


def _join(frame: ClientFrame) -> bytes:
    return frame if isinstance(frame, bytes) else b"".join(frame)
