"""TCPROS on a node's connections: frames and the exchange of headers, with limits of size and time."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass

from roswire.definitions import Definitions
from roswire.errors import LimitExceededError, ProtocolError
from roswire.node.network import ByteWriter, NodeMemory
from roswire.tcpros import HEADER_LIMIT, decode_header, encode_header

ANY = "*"
"""The md5sum or name that matches any type."""

_LENGTH = struct.Struct("<I")
_SMALL_BYTES = 1 << 16  # a frame that is read without asking for memory
_COPIES = 2  # of a frame that has just come whole


@dataclass(frozen=True, slots=True)
class NodeLimits:
    """The limits of a node. Times are in seconds."""

    message_bytes: int = 64 << 20
    connections: int = 256  # from other nodes, to its topics, services and API
    publishers: int = 256  # of one topic
    header_seconds: float = 10.0
    call_seconds: float = 10.0  # a call of the master or of another node
    queue_bytes: int = 64 << 20  # that wait for all subscribers, unless the node shares a memory with others
    arriving_bytes: int = 64 << 20  # of all frames of more than 64 KB that have not come whole


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type with the full text of its `definition`."""

    name: str
    md5sum: str
    definition: str

    @classmethod
    def of(cls, definitions: Definitions, name: str) -> "MessageType":
        return cls(name, definitions.md5sum(name), definitions.full_text(name))


ANY_TYPE = MessageType(ANY, ANY, "")


async def read_frame(reader: asyncio.StreamReader, limit: int) -> bytes:
    """Return the next frame. Raise `LimitExceededError` before reading a frame that is too long, or `OSError`."""
    try:
        return await reader.readexactly(await _read_size(reader, limit))
    except asyncio.IncompleteReadError:
        raise _end_error() from None


@contextlib.asynccontextmanager
async def held_frame(reader: asyncio.StreamReader, limit: int, memory: NodeMemory) -> AsyncIterator[bytes]:
    """Yield the next frame, and hold its memory during the block.

    Raise `LimitExceededError` if the frame is too long or does not fit into the memory, or `OSError`.
    """
    try:
        size = await _read_size(reader, limit)
        held = _COPIES * size
        if size > _SMALL_BYTES and (reason := memory.refusal(held)):
            raise LimitExceededError(f"no memory for a frame of {size} bytes: {reason}")
        memory.add(held)
        try:
            yield await reader.readexactly(size)
        finally:
            memory.add(-held)
    except asyncio.IncompleteReadError:
        raise _end_error() from None


async def _read_size(reader: asyncio.StreamReader, limit: int) -> int:
    (size,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
    if size > limit:
        raise LimitExceededError(f"frame of {size} bytes; at most {limit} are allowed")
    return int(size)


def _end_error() -> ConnectionResetError:
    return ConnectionResetError("the peer ended the connection")


async def read_header(reader: asyncio.StreamReader, seconds: float) -> dict[str, str]:
    """Return the peer's header. Raise `ProtocolError`, or `OSError` if the connection ends or the time has passed."""
    async with asyncio.timeout(seconds):
        return decode_header(await read_frame(reader, HEADER_LIMIT))


async def exchange_headers(
    reader: asyncio.StreamReader, writer: ByteWriter, header: Mapping[str, str], seconds: float
) -> dict[str, str]:
    """Send a header and return the answer. Raise `ProtocolError` with the peer's reason, or `OSError`."""
    writer.write(encode_header(header))
    return require_accepted(await read_header(reader, seconds))


def require_accepted(answer: dict[str, str]) -> dict[str, str]:
    """Return a peer's answer, or raise `ProtocolError` with its reason if it rejects the connection."""
    if "error" in answer:
        raise ProtocolError(f"the peer rejected the connection: {answer['error'][:1000]}")
    return answer


def refuse(writer: ByteWriter, reason: str) -> None:
    """End a connection with a reason, which the peer's node logs."""
    writer.write(encode_header({"error": reason}))
    writer.close()
