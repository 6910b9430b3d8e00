"""Encode texts as PNG images, for rosbridge's compression `png`.

Compressing a large text takes a long time, so it is divided into steps, between which a door serves its other
clients. The text is JSON, and becomes ASCII first: in a browser, roslib takes each byte of the pixels for a character.
"""

import base64
import json
import math
import re
import struct
import zlib
from collections.abc import Iterator
from typing import TypeAlias

from appliance.features.doors.client_frames import ClientFrame, text_frame

_STEP_BYTES = 3 << 14  # of the text, or of the image: about a millisecond
_NOT_ASCII = bytes(range(128, 256))
_OTHERS = re.compile(rb"[\x80-\xff]++")


class PngFrame:
    """A frame that is made in steps; `frame` is None until it is complete. `size` is the most memory that it takes."""

    def __init__(self, text: bytes) -> None:
        escapes = 0 if text.isascii() else len(text) - len(text.translate(None, _NOT_ASCII))
        self.size = 2 * (len(text) + 2 * escapes)
        self.frame: ClientFrame | None = None
        self._steps = self._make(text)

    def step(self) -> None:
        """Do a part of the work; clients that share the frame also share its steps."""
        next(self._steps, None)

    def _make(self, text: bytes | bytearray) -> Iterator[None]:
        image, encoded = bytearray(), bytearray(b'{"op":"png","data":"')
        if not text.isascii():
            escaped = bytearray()
            for part in _in_ascii(text):
                escaped += part
                yield
            text = escaped
            del escaped
        parts = _image(text)
        del text  # each part of the memory ends with its use
        for part in parts:
            image += part
            yield
        del parts
        for start in range(0, len(image), _STEP_BYTES):
            encoded += base64.b64encode(image[start : start + _STEP_BYTES])
            yield
        encoded += b'"}'
        self.frame = text_frame(encoded)


DoorFrame: TypeAlias = ClientFrame | PngFrame


def _in_ascii(text: bytes | bytearray) -> Iterator[bytes]:
    """Yield the parts of a JSON text in ASCII. At most three bytes become of each that is not."""
    start = 0
    while start < len(text):
        end = min(start + _STEP_BYTES, len(text))
        while end < len(text) and text[end] & 0xC0 == 0x80:  # inside a character
            end += 1
        yield _OTHERS.sub(lambda found: json.dumps(found[0].decode())[1:-1].encode(), text[start:end])
        start = end


def _image(data: bytes | bytearray) -> Iterator[bytes]:
    """Yield the parts of an image whose pixels (8-bit RGB) are these bytes, filled up with line feeds."""
    width = max(math.isqrt(len(data) // 3), 1)
    height = -(-len(data) // (3 * width))
    row = 3 * width
    step = row * max(_STEP_BYTES // row, 1)
    yield b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    compression = zlib.compressobj(1)
    for begin in range(0, row * height, step):
        end = min(begin + step, row * height)
        part = data[begin:end].ljust(end - begin, b"\n")
        rows = b"".join(b"\0" + part[start : start + row] for start in range(0, len(part), row))
        compressed = compression.compress(rows)
        yield _chunk(b"IDAT", compressed) if compressed else b""
    yield _chunk(b"IDAT", compression.flush()) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
