"""The frames of the rosbridge protocol, version 2: the operations of clients as structs, and frames to clients."""

import struct
from functools import lru_cache
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Raw, Struct

from appliance.features.doors.cbor_frames import json_of_cbor
from appliance.features.doors.client_frames import ClientFrame, binary_frame, text_frame
from appliance.features.doors.client_requests import ClientId
from appliance.features.doors.known_types import DoorMessage
from appliance.features.doors.values import cbor
from roswire.errors import PeerError, quote

_MAX_CHARACTERS = 1024
_MAX_INTEGER = (1 << 63) - 1
Name = Annotated[str, Meta(max_length=_MAX_CHARACTERS)]
Id = (
    Annotated[str, Meta(max_length=_MAX_CHARACTERS)]
    | Annotated[int, Meta(ge=-_MAX_INTEGER, le=_MAX_INTEGER)]
    | float
    | None
)
Compression = Literal["none", "cbor", "cbor-raw"]
_Count = Annotated[int, Meta(ge=0, le=1_000_000)]
_NOTHING = Raw(b"{}")


class _Operation(Struct, tag_field="op", kw_only=True):
    id: Id = None


class AdvertiseOp(_Operation, tag="advertise"):
    """Advertise a topic. `will` is published if the connection ends before `unadvertise`."""

    topic: Name
    type: Name
    latch: bool = False
    queue_size: _Count = 100
    will: Raw = Raw()


class UnadvertiseOp(_Operation, tag="unadvertise"):
    """Withdraw an advertisement; without an id, all advertisements of the topic."""

    topic: Name


class PublishOp(_Operation, tag="publish"):
    """Publish a message."""

    topic: Name
    msg: Raw = _NOTHING
    latch: bool = False
    queue_size: _Count = 100


class SubscribeOp(_Operation, tag="subscribe"):
    """Subscribe to a topic."""

    topic: Name
    type: Name | None = None
    throttle_rate: Annotated[int, Meta(ge=0, le=86_400_000)] | None = 0
    """The least number of milliseconds between two messages."""
    queue_length: _Count | None = 0
    compression: Compression | Literal["png"] = "none"
    fragment_size: int | None = None


class UnsubscribeOp(_Operation, tag="unsubscribe"):
    """End a subscription; without an id, all subscriptions to the topic."""

    topic: Name


class CallServiceOp(_Operation, tag="call_service"):
    """Call a service."""

    service: Name
    args: Raw = _NOTHING
    timeout: float | None = None
    """In seconds."""


class AdvertiseServiceOp(_Operation, tag="advertise_service"):
    """Offer a service."""

    service: Name
    type: Name


class UnadvertiseServiceOp(_Operation, tag="unadvertise_service"):
    """Withdraw an offered service."""

    service: Name


class ServiceResponseOp(_Operation, tag="service_response"):
    """Answer a call of an offered service."""

    service: Name
    values: Raw = _NOTHING
    result: bool = True


class SetLevelOp(_Operation, tag="set_level"):
    """Set the level from which statuses are sent."""

    level: Literal["info", "warning", "error", "none"]


class StatusOp(_Operation, tag="status"):
    """A status of the client, which has no effect."""


Operation = (
    AdvertiseOp
    | UnadvertiseOp
    | PublishOp
    | SubscribeOp
    | UnsubscribeOp
    | CallServiceOp
    | AdvertiseServiceOp
    | UnadvertiseServiceOp
    | ServiceResponseOp
    | SetLevelOp
    | StatusOp
)
OPERATIONS = (
    "advertise", "unadvertise", "publish", "subscribe", "unsubscribe", "call_service", "advertise_service",
    "unadvertise_service", "service_response", "set_level", "status",
)  # fmt: skip


class Envelope(Struct):
    """The common fields, for an operation that cannot be decoded."""

    op: Any = None
    id: Any = None
    receiver: Any = None


def publish_frame(message: DoorMessage, form: tuple[str, Compression]) -> ClientFrame:
    """Return the frame of a message in one form: the clients' spelling of its topic, and their compression.

    Raise `MessageValueError` if the message does not fit its definition.
    """
    topic, compression = form
    if compression == "cbor-raw":
        secs, nsecs = divmod(message.received, 1_000_000_000)
        head = _RAW.pack(_RAW_SECS, secs, _RAW_NSECS, nsecs, _RAW_BYTES, len(message.body))
        return binary_frame(_publish_head(topic) + head, message.body)
    if compression == "cbor":
        return binary_frame(_publish_head(topic) + b"\x63msg", message.type.codec.cbor(message.body))
    return json_frame({"op": "publish", "topic": topic, "msg": message.type.codec.json(message.body)})


_RAW_SECS, _RAW_NSECS, _RAW_BYTES = b"\x63msg\xa3\x64secs\x1a", b"\x65nsecs\x1a", b"\x65bytes\x5a"
_RAW = struct.Struct(f">{len(_RAW_SECS)}sI{len(_RAW_NSECS)}sI{len(_RAW_BYTES)}sI")
"""The CBOR of a raw message without its bytes, which follow: a map of three fields."""


@lru_cache(maxsize=256)
def _publish_head(topic: str) -> bytes:
    return b"\xa3\x62op\x67publish\x65topic" + cbor(topic)


def json_frame(fields: dict[str, object], reply_to: ClientId = None) -> ClientFrame:
    return text_frame(msgspec.json.encode(fields if reply_to is None else fields | {"id": reply_to}))


def type_name(text: str) -> str:
    """Return `PACKAGE/NAME` without the additional slashes that rosbridge accepts."""
    parts = [part for part in text.split("/") if part]
    if len(parts) != 2:
        raise OperationError(f"{quote(text)} is not a type; write PACKAGE/NAME")
    return "/".join(parts)


class OperationError(PeerError):
    """An operation that cannot be carried out."""


_OPERATION: msgspec.json.Decoder[Operation] = msgspec.json.Decoder(Operation)
_ENVELOPE = msgspec.json.Decoder(Envelope)


def json_of_binary(frame: bytes) -> bytes:
    """Return the JSON of a binary frame, which is CBOR unless it begins like a JSON object."""
    return frame if frame.lstrip()[:1] == b"{" else json_of_cbor(frame)


def decode_operation(text: bytes) -> Operation:
    try:
        return _OPERATION.decode(text)
    except (ValueError, RecursionError) as error:
        raise OperationError(_complaint(text, error)) from None


def _complaint(text: bytes, error: Exception) -> str:
    envelope = _envelope(text)
    if envelope is None:
        return f"not a rosbridge operation: {error}"
    if envelope.op is None:
        version = " (rosbridge 1.0 is not supported)" if envelope.receiver is not None else ""
        return f"an operation without `op`{version}; the operations are {', '.join(OPERATIONS)}"
    if envelope.op == "fragment":
        return "a door joins no fragments: send the whole operation in one frame"
    if envelope.op not in OPERATIONS:
        return f"unknown operation {quote(str(envelope.op))}; the operations are {', '.join(OPERATIONS)}"
    return f"{envelope.op}: {error}"


def id_of(text: bytes) -> ClientId:
    try:
        envelope = _envelope(text)
        return None if envelope is None else msgspec.convert(envelope.id, Id)
    except ValueError:
        return None


def _envelope(text: bytes) -> Envelope | None:
    try:
        return _ENVELOPE.decode(text)
    except (ValueError, RecursionError):
        return None
