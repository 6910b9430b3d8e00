"""Define the requests of a client to the node of its door, in the client's order.

`reply_to` is the id that the client gave, which the answer or the refusal repeats. Names are canonical.
"""

from dataclasses import dataclass
from typing import TypeAlias

import msgspec

ClientId: TypeAlias = str | int | float | None
"""The id of a client's operation, or None."""


@dataclass(frozen=True, slots=True)
class AdvertiseTopic:
    """Advertise a topic."""

    topic: str
    type: str | None
    """None: the type that other nodes of the topic use."""
    latched: bool = False
    queue: int = 100
    reply_to: ClientId = None
    will: msgspec.Raw | None = None
    """A message that is published if the connection ends while the topic is advertised."""
    repeated: bool = False
    """Whether a message repeats an advertisement that was refused, which the node may remember for a second."""


@dataclass(frozen=True, slots=True)
class UnadvertiseTopic:
    """Withdraw an advertisement."""

    topic: str
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class PublishMessage:
    """Publish JSON values or the bytes of the message."""

    topic: str
    values: msgspec.Raw | bytes
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class SubscribeTopic:
    """Subscribe to a topic. If `type` is given, a topic of another type is refused."""

    topic: str
    type: str | None = None
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class UnsubscribeTopic:
    """End a subscription."""

    topic: str
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class CallOfService:
    """Call a service; `values` are an object, or a list of values in order."""

    service: str
    call: int
    values: msgspec.Raw | bytes
    seconds: float | None = None
    reply_to: ClientId = None
    type: str | None = None
    """The type for which the client wrote `values`; None for values by name."""


@dataclass(frozen=True, slots=True)
class OfferService:
    """Offer a service, whose calls go to the client."""

    service: str
    type: str
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class WithdrawService:
    """Withdraw an offered service."""

    service: str
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class AnswerCall:
    """Answer a call: with values, or with the reason of the failure."""

    service: str
    call: str
    ok: bool
    values: msgspec.Raw
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class ReadParameters:
    """Read parameters by name; without names, all of them."""

    names: tuple[str, ...]
    reply_to: str | None = None


@dataclass(frozen=True, slots=True)
class WriteParameter:
    """Set a parameter to a JSON value; None deletes it."""

    name: str
    value: msgspec.Raw | None
    reply_to: str | None = None


@dataclass(frozen=True, slots=True)
class SubscribeParameter:
    """Subscribe to a parameter, or to all below a namespace."""

    name: str
    reply_to: ClientId = None


@dataclass(frozen=True, slots=True)
class UnsubscribeParameter:
    """End a subscription to a parameter."""

    name: str
    reply_to: ClientId = None


DoorRequest: TypeAlias = (
    AdvertiseTopic
    | UnadvertiseTopic
    | PublishMessage
    | SubscribeTopic
    | UnsubscribeTopic
    | CallOfService
    | OfferService
    | WithdrawService
    | AnswerCall
    | ReadParameters
    | WriteParameter
    | SubscribeParameter
    | UnsubscribeParameter
)
