"""The values of messages in JSON and CBOR: what a door sends to its clients, and what it accepts from them."""

from dataclasses import dataclass
from typing import Any

import cbor2
import msgspec

from appliance.features.doors.message_reader import MessageReader
from appliance.features.doors.message_writer import MessageWriter
from roswire.definitions import Definitions


@dataclass(frozen=True, slots=True)
class ValueLimits:
    """Upper bounds for one message."""

    message_bytes: int = 16 << 20  # of a message that a client makes
    values: int = 1_000_000  # of a message that JSON or CBOR shows


class MessageCodec:
    """Converts the messages of one type. Raises `DefinitionError` if its definition cannot be used."""

    def __init__(self, definitions: Definitions, name: str, limits: ValueLimits) -> None:
        self.name = name
        self._json = MessageReader(definitions, name, typed_arrays=False, most_values=limits.values)
        self._cbor = MessageReader(definitions, name, typed_arrays=True, most_values=limits.values)
        self.writer = MessageWriter(definitions, name, most_bytes=limits.message_bytes)

    def json(self, data: bytes) -> msgspec.Raw:
        """Return a message as JSON: bytes as base64, NaN and infinity as null. Raises `MessageValueError`."""
        return msgspec.Raw(msgspec.json.encode(self._json.read(data)))

    def cbor_values(self, data: bytes) -> dict[str, Any]:
        """Return a message as values that `cbor` encodes. Raises `MessageValueError`."""
        return self._cbor.read(data)


def cbor(values: Any) -> bytes:
    return cbor2.dumps(values)
