"""The messages that a door hears, and their encodings in JSON and CBOR, which clients share.

An encoding can take 20 times as much memory as the message, and a message waits as long as its slowest client. So
encodings belong to no message: only those of the latest messages are kept, and a client that falls behind gets its own.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from msgspec import Raw

from appliance.features.doors.values import MessageCodec, cbor

_MOST_BYTES = 8 << 20
_Kind = Literal["json", "cbor"]


class RecentEncodings:
    """The encodings that were made last, of at most `most_bytes` with their messages, but always the last one.

    `codec_of` returns the codec for the messages with a publisher's header, or raises `DefinitionError`.
    """

    def __init__(
        self, codec_of: Callable[[Mapping[str, str]], MessageCodec], most_bytes: int = _MOST_BYTES
    ) -> None:
        self._codec_of = codec_of
        self._most_bytes = most_bytes
        self._bytes = 0
        self._made: OrderedDict[tuple[DoorMessage, _Kind], bytes] = OrderedDict()

    def json(self, message: "DoorMessage") -> bytes:
        """Return a message as JSON; raises `MessageValueError`, or `DefinitionError` without a usable definition."""
        return self._made.get((message, "json")) or self._keep(
            message, "json", bytes(self._codec_of(message.header).json(message.body))
        )

    def cbor(self, message: "DoorMessage") -> bytes:
        """Return a message as CBOR; raises as `json` does."""
        return self._made.get((message, "cbor")) or self._keep(
            message, "cbor", cbor(self._codec_of(message.header).cbor_values(message.body))
        )

    def _keep(self, message: "DoorMessage", kind: _Kind, encoded: bytes) -> bytes:
        self._made[message, kind] = encoded
        self._bytes += len(message.body) + len(encoded)
        while self._bytes > self._most_bytes and len(self._made) > 1:
            (earlier, _kind), dropped = self._made.popitem(last=False)
            self._bytes -= len(earlier.body) + len(dropped)
        return encoded


@dataclass(eq=False, slots=True)  # a frozen one takes twice as long to make, for each message
class DoorMessage:
    """A message that came on a topic, with its publisher's header. `received` is the system time in nanoseconds."""

    topic: str
    body: bytes
    header: Mapping[str, str]
    received: int
    encodings: RecentEncodings = field(repr=False)

    @property
    def json(self) -> Raw:
        """The message as JSON; raises `MessageValueError`, or `DefinitionError` if its definition cannot be used."""
        return Raw(self.encodings.json(self))

    @property
    def cbor(self) -> bytes:
        return self.encodings.cbor(self)
