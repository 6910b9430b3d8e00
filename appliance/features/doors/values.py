"""The values of messages in JSON and CBOR: what a door sends to its clients, and what it accepts from them."""

from dataclasses import dataclass

import cbor2
import msgspec

from appliance.features.doors.message_reader import MessageReader, MessageValueError
from appliance.features.doors.message_writer import MessageWriter
from roswire.definitions import Definitions
from roswire.tcpros import Body


@dataclass(frozen=True, slots=True)
class ValueLimits:
    """Upper bounds for one message."""

    message_bytes: int = 16 << 20  # of a message that a client makes
    shown_bytes: int = 32 << 20  # of a message that JSON or CBOR shows
    values: int = 1_000_000  # of a message that JSON or CBOR shows


class MessageCodec:
    """Converts the messages of one type. Raises `DefinitionError` if its definition cannot be used."""

    def __init__(self, definitions: Definitions, name: str, limits: ValueLimits) -> None:
        self.name = name
        self._limits = limits
        self._json = MessageReader(definitions, name, typed_arrays=False, most_values=limits.values)
        self._cbor = MessageReader(definitions, name, typed_arrays=True, most_values=limits.values)
        self.writer = MessageWriter(definitions, name, most_bytes=limits.message_bytes)

    def json(self, data: Body) -> msgspec.Raw:
        """Return JSON with bytes as base64, and NaN and infinity as null."""
        self._check(data)
        return msgspec.Raw(msgspec.json.encode(self._json.read(data)))

    def cbor(self, data: Body) -> bytes:
        self._check(data)
        return cbor(self._cbor.read(data))

    def _check(self, data: Body) -> None:
        if len(data) > self._limits.shown_bytes:
            raise MessageValueError(
                f"a message of {len(data)} bytes; as JSON or CBOR at most {self._limits.shown_bytes}: subscribe with"
                " cbor-raw"
            )


def cbor(values: object) -> bytes:
    return cbor2.dumps(values)
