"""The messages between an active appliance and its standby, and the frames that carry them.

A frame is a length (4 bytes) and one message as MessagePack. The standby sends its position as `Stored`, first and
after each message. The active appliance sends the later `Changes`, at least one message a second, or a snapshot.
"""

import asyncio
import contextlib
import math
import struct
from typing import Annotated, Generic, TypeVar

import msgspec

from appliance.base import clock
from appliance.channel.messages import Fingerprint
from appliance.store.changes import Change, Put

LARGEST_FRAME = 128 << 20  # more than a parameter tree, the largest value of the state
_PIECE = 256 << 10
_WRITE_SECONDS = 30.0
_LENGTH = struct.Struct(">I")
_LONGEST_REASON = 500
_REFUSED_SECONDS = 60.0

M = TypeVar("M")
_Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]
_History = Annotated[str, msgspec.Meta(max_length=64)]


class ReplicationError(Exception):
    """The link between the appliances ended; the message has the reason."""


class Stored(msgspec.Struct, frozen=True, array_like=True, tag="stored"):
    """The standby has stored all changes up to `number` of this history; `epoch` is the last it has seen."""

    epoch: _Number
    history: _History
    number: _Number


class SwitchoverWanted(msgspec.Struct, frozen=True, array_like=True, tag="switchover"):
    """An operator on the standby ordered it to take over."""


class SwitchoverRefused(msgspec.Struct, frozen=True, array_like=True, tag="switchover refused"):
    """The active appliance does not hand over."""

    reason: Annotated[str, msgspec.Meta(max_length=_LONGEST_REASON)]


class Introduction(msgspec.Struct, frozen=True, array_like=True, tag="introduction"):
    """The standby asks for a certificate for its own tunnel key, with a signing request (PEM)."""

    request: Annotated[bytes, msgspec.Meta(max_length=16 << 10)]
    key: Fingerprint
    endpoint: Annotated[str, msgspec.Meta(pattern=r"^[0-9A-Za-z.:-]{1,253}\Z")]
    """The address or name at which hosts reach the standby."""
    pin: Annotated[str, msgspec.Meta(pattern=r"^(sha256//[A-Za-z0-9+/]{43}=)?\Z")]
    """The pin of the standby's REST server, or empty if REST is off."""


class ObstacleFound(msgspec.Struct, frozen=True, array_like=True, tag="obstacle"):
    """Why the standby could not serve after a takeover, or empty once it could."""

    reason: Annotated[str, msgspec.Meta(max_length=_LONGEST_REASON)]


class Refused(msgspec.Struct, frozen=True, array_like=True, tag="refused"):
    """The sender of this message ends the link."""

    reason: Annotated[str, msgspec.Meta(max_length=_LONGEST_REASON)]


class Changes(msgspec.Struct, frozen=True, array_like=True, tag="changes"):
    """The changes from number `first` on; none if nothing has changed."""

    epoch: _Number
    history: _History
    first: _Number
    changes: list[Change]


class EncodedChanges(msgspec.Struct, frozen=True, array_like=True, tag="changes"):
    """Like `Changes`, with changes that are already encoded."""

    epoch: int
    history: str
    first: int
    changes: list[msgspec.Raw]


class SnapshotBegin(msgspec.Struct, frozen=True, array_like=True, tag="snapshot"):
    """The beginning of a snapshot: all rows as they were after the change `number`."""

    epoch: _Number
    history: _History
    number: _Number


class SnapshotRows(msgspec.Struct, frozen=True, array_like=True, tag="rows"):
    """Some rows of a snapshot."""

    rows: list[Put]


class SnapshotEnd(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """The snapshot is complete, with this number of rows."""

    rows: _Number


FromActive = Changes | SnapshotBegin | SnapshotRows | SnapshotEnd | Refused | SwitchoverRefused
FromStandby = Stored | Introduction | ObstacleFound | Refused | SwitchoverWanted


def reason_of(error: Exception) -> Refused:
    return Refused(str(error)[:_LONGEST_REASON])


def refusal_of(reason: str) -> SwitchoverRefused:
    return SwitchoverRefused(reason[:_LONGEST_REASON])


def obstacle_of(reason: str) -> ObstacleFound:
    return ObstacleFound(reason[:_LONGEST_REASON])


class LastRefusal:
    """Why the standby last refused a change: until it accepts one, or has been away for `_REFUSED_SECONDS`.

    Each link to it begins as if it accepted, so without this the reason would come and go with the links.
    """

    def __init__(self) -> None:
        self._reason, self._until = "", 0.0

    @property
    def reason(self) -> str:
        return self._reason if clock.now() < self._until else ""

    def note(self, reason: str) -> None:
        self._reason, self._until = reason, clock.now() + _REFUSED_SECONDS

    def end(self) -> None:
        self._until = 0.0


class ReplicationLink(Generic[M]):
    """One end of the link, which receives messages of one type."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, received: object) -> None:
        self._reader = reader
        self._writer = writer
        self._encoder = msgspec.msgpack.Encoder()
        self._sending = asyncio.Lock()
        self._decoder: msgspec.msgpack.Decoder[M] = msgspec.msgpack.Decoder(received)
        self._taken = -math.inf  # when the other appliance last took bytes, by the event loop

    async def send(self, message: object) -> None:
        body = self._encoder.encode(message)
        if len(body) > LARGEST_FRAME:
            raise ReplicationError(
                f"a change has {len(body)} bytes, and the standby gets at most {LARGEST_FRAME}: make"
                " limits.parameter_bytes smaller"
            )
        async with self._sending:
            await self._write(_LENGTH.pack(len(body)) + body[:_PIECE])
            for begin in range(_PIECE, len(body), _PIECE):
                await asyncio.sleep(0)  # encryption of all pieces at once would hold the loop
                await self._write(body[begin : begin + _PIECE])

    async def _write(self, data: bytes) -> None:
        self._writer.write(data)
        try:
            async with asyncio.timeout(_WRITE_SECONDS):
                await self._writer.drain()
        except TimeoutError as error:
            raise ReplicationError(f"the other appliance took nothing for {_WRITE_SECONDS:g} s") from error
        except OSError as error:
            raise ReplicationError(f"the link was lost: {error}") from error
        self._taken = asyncio.get_running_loop().time()

    async def receive(self, seconds: float) -> M:
        """Return the next message. A large frame may take longer than `seconds`, while its bytes are sent."""
        try:
            (length,) = _LENGTH.unpack(await self._header(seconds))
            if length > LARGEST_FRAME:
                raise ReplicationError(f"a frame of {length} bytes; at most {LARGEST_FRAME} are allowed")
            body = bytearray()
            while len(body) < length:
                async with asyncio.timeout(seconds):
                    piece = await self._reader.read(length - len(body))
                if not piece:
                    raise asyncio.IncompleteReadError(bytes(body), length)
                body += piece
        except TimeoutError as error:
            raise ReplicationError(f"the other appliance sent nothing for {seconds:g} s") from error
        except asyncio.IncompleteReadError as error:
            raise ReplicationError("the other appliance closed the link") from error
        except OSError as error:
            raise ReplicationError(f"the link was lost: {error}") from error
        try:
            return self._decoder.decode(body)
        except (ValueError, RecursionError) as error:
            raise ReplicationError(f"a message is malformed: {error}") from error

    async def _header(self, seconds: float) -> bytes:
        """An appliance that takes a large frame cannot answer before it has the whole."""
        until = asyncio.get_running_loop().time() + seconds
        while True:
            try:
                async with asyncio.timeout_at(until):
                    return await self._reader.readexactly(_LENGTH.size)
            except TimeoutError:
                if self._taken + seconds <= until:  # times that are compared, not a rest that rounding leaves
                    raise
                until = self._taken + seconds

    async def close(self) -> None:
        self._writer.transport.abort()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()
