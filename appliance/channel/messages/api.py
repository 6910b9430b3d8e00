"""The link control <-> api. The api passes on each client's request and credentials; control verifies them."""

import math
from typing import Annotated, ClassVar

import msgspec

from appliance.channel.messages.message import Message
from appliance.channel.operations import RestRequest


class ClientRequest(msgspec.Struct, frozen=True):
    """The unmodified HTTP request of a change, from the peer `host`; missing headers are empty."""

    host: str
    method: str
    target: str
    if_match: str
    content_type: str
    proof: str
    body: bytes


class RequestMade(Message):
    """A client's request; its answer repeats `number`.

    `shown` is the token or reading key, empty if none is needed. A change also has `asked`. A request without effect
    by `until` (monotonic seconds) is withdrawn.
    """

    number: int
    request: RestRequest
    shown: str = ""
    asked: ClientRequest | None = None
    until: float = math.inf


class RequestWithdrawn(Message):
    """The client disconnected: its order is withdrawn if it has not taken effect."""

    number: int


class RequestAnswered(Message):
    """The answer to a request, as on the admin socket."""

    number: int
    answer: bytes


class ConnectionPassed(Message):
    """A WebSocket for a door, after TLS, with the ticket in its URL.

    The api has read the head of the request, and sends it again.
    """

    descriptors: ClassVar[int] = 1
    number: int
    name: str
    ticket: str
    peer: str


class ConnectionAnswered(Message):
    """Tells whether a connection is accepted; otherwise, it has an HTTP status and the reason."""

    number: int
    status: int
    reason: str


class TokenKept(msgspec.Struct, frozen=True):
    """A token without its secret, usable or `ended`; `expires` is seconds since the epoch.

    An ended one is only refused, with the reason. The hash of the reading key, `reading`, is empty for tokens of an
    early version.
    """

    id: str
    name: str
    role: str
    salt: bytes
    hash: bytes
    expires: float
    reading: bytes = b""
    ended: bool = False


class TokensStated(Message):
    """All usable tokens, the latest ended ones, and all blocked hosts: at the start, and after every change."""

    tokens: list[TokenKept]
    blocked: list[str] = msgspec.field(default_factory=list)


class LongRequest(msgspec.Struct, frozen=True):
    """Requests of one client that run for seconds, such as those of followers."""

    host: str
    who: str
    path: str
    count: int


class RequestsRunning(Message):
    """All long requests, after every change."""

    requests: list[LongRequest]


class TokenUsed(Message):
    """A token was presented; reported at most once a minute for each."""

    token: str


class RestCalled(Message):
    """REST calls for the audit log. `who` is the token's name, empty for an invalid token.

    `count` equal calls, collected for at least a second, are one message with the `duration_us` of the first.
    """

    host: str
    who: str
    method: str
    path: str
    status: int
    reason: str
    duration_us: int
    count: int = 1
    dry: bool = False


class RestServed(Message):
    """The pin of the api's key (`sha256//…`) and the SHA-256 of its certificate, empty in clear text."""

    pin: Annotated[str, msgspec.Meta(pattern="^(sha256//[A-Za-z0-9+/]{43}=)?$")]
    certificate: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")] = ""


ApiLink = (
    RequestMade
    | RequestWithdrawn
    | RequestAnswered
    | TokensStated
    | RequestsRunning
    | TokenUsed
    | RestCalled
    | RestServed
    | ConnectionPassed
    | ConnectionAnswered
)
