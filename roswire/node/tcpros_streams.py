"""TCPROS on a node's connections: the exchange of headers, with limits of size and time."""

import asyncio
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from roswire.definitions import Definitions
from roswire.errors import LimitExceededError, ProtocolError
from roswire.node.network import ByteWriter
from roswire.tcpros import HEADER_LIMIT, decode_header, encode_header

ANY = "*"
"""The md5sum, or the name, of any type."""

_LENGTH = struct.Struct("<I")
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class NodeLimits:
    """The limits of a node; times are in seconds."""

    message_bytes: int = 64 << 20
    connections: int = 256  # from other nodes, to its topics, services and API
    publishers: int = 256  # of one topic
    header_seconds: float = 10.0
    call_seconds: float = 10.0  # a call of the master or of another node
    queue_bytes: int = 64 << 20  # that wait for all subscribers, unless the node shares a memory with others


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type; `definition` is the full text."""

    name: str
    md5sum: str
    definition: str

    @classmethod
    def defined(cls, definitions: Definitions, name: str) -> "MessageType":
        """Return the message type of a name. Raises `DefinitionError`."""
        return cls(name, definitions.md5sum(name), definitions.full_text(name))


ANY_TYPE = MessageType(ANY, ANY, "")
"""The type of a subscriber that accepts every type."""


async def read_frame(reader: asyncio.StreamReader, limit: int) -> bytes:
    """Return a frame. Raises `LimitExceededError` as soon as the announced length exceeds the limit, and
    `OSError` if the connection ends.
    """
    try:
        return await reader.readexactly(_size(await reader.readexactly(_LENGTH.size), 0, limit))
    except asyncio.IncompleteReadError:
        raise _ended() from None


class FrameReader:
    """Reads the frames of one connection: small ones many at once, and large ones without a further copy."""

    def __init__(self, reader: asyncio.StreamReader, limit: int) -> None:
        self._reader = reader
        self._limit = limit
        self._begun = b""
        self._large = False  # whether the last frame was

    async def next(self) -> list[bytes]:
        """Return the next frames, at least one. Raises the errors of `read_frame`."""
        try:
            if self._large and not self._begun:
                return [self._noted(await read_frame(self._reader, self._limit))]
            while not (frames := self._complete()):
                if len(self._begun) >= _LENGTH.size:
                    return [await self._rest()]
                data = await self._reader.read(_READ_BYTES)
                if not data:
                    raise _ended()
                self._begun += data
            return frames
        except asyncio.IncompleteReadError:
            raise _ended() from None

    async def _rest(self) -> bytes:
        begun, self._begun = self._begun, b""
        missing = _LENGTH.size + _size(begun, 0, self._limit) - len(begun)
        return self._noted(begun[_LENGTH.size :] + await self._reader.readexactly(missing))

    def _complete(self) -> list[bytes]:
        data, begin, frames = self._begun, 0, []
        while (body := begin + _LENGTH.size) <= len(data):
            end = body + _size(data, begin, self._limit)
            if end > len(data):
                break
            frames.append(self._noted(data[body:end]))
            begin = end
        self._begun = data[begin:]
        return frames

    def _noted(self, frame: bytes) -> bytes:
        self._large = len(frame) > _READ_BYTES
        return frame


def _size(data: bytes, begin: int, limit: int) -> int:
    """Return the length that a frame announces. Raises `LimitExceededError`."""
    (size,) = _LENGTH.unpack_from(data, begin)
    if size > limit:
        raise LimitExceededError(f"frame of {size} bytes; at most {limit} are allowed")
    return int(size)


def _ended() -> ConnectionResetError:
    return ConnectionResetError("the peer ended the connection")


async def read_header(reader: asyncio.StreamReader, seconds: float) -> dict[str, str]:
    """Return a header. Raises `ProtocolError`, or `OSError` if the connection ends or the time limit passes."""
    async with asyncio.timeout(seconds):
        return decode_header(await read_frame(reader, HEADER_LIMIT))


async def exchange_headers(
    reader: asyncio.StreamReader, writer: ByteWriter, header: Mapping[str, str], seconds: float
) -> dict[str, str]:
    """Send a header and return the answer.

    Raises `ProtocolError` with the peer's reason if it rejects the connection, or `OSError`.
    """
    writer.write(encode_header(header))
    answer = await read_header(reader, seconds)
    if "error" in answer:
        raise ProtocolError(f"the peer rejected the connection: {answer['error'][:1000]}")
    return answer


def refuse(writer: ByteWriter, reason: str) -> None:
    """Refuse a connection with a reason, which the peer's node logs."""
    writer.write(encode_header({"error": reason}))
    writer.close()
