"""The link control <-> api. The api passes on the client's request with its credentials, which control verifies. The
api's requests are the union `RestRequest`, which cannot make a token.
"""

import math
from typing import Annotated

import msgspec

from appliance.channel.admin import RestRequest
from appliance.channel.messages.message import Message


class ClientRequest(msgspec.Struct, frozen=True):
    """The HTTP request of a change as it came, from the peer `host`; missing headers are empty."""

    host: str
    method: str
    target: str
    if_match: str
    content_type: str
    proof: str
    body: bytes


class RequestMade(Message):
    """Pass on a client's request; `number` pairs it with its answer.

    `shown` is the token or reading key that came with it, empty if none is needed. A change also has `asked`. A request
    that has not taken effect by `until` (seconds of the monotonic clock, which all processes share) is withdrawn.
    """

    number: int
    request: RestRequest
    shown: str = ""
    asked: ClientRequest | None = None
    until: float = math.inf


class RequestWithdrawn(Message):
    """The client of the request with this number is gone: its order is withdrawn if it has not taken effect."""

    number: int


class RequestAnswered(Message):
    """Control's answer to `RequestMade` with the same number: the document that the admin socket would carry."""

    number: int
    answer: bytes


class TokenKept(msgspec.Struct, frozen=True):
    """A usable token, without its secret; `expires` is seconds since the epoch.

    `reading` is the hash of its reading key, empty for a token of a version that had none.
    """

    id: str
    name: str
    role: str
    salt: bytes
    hash: bytes
    expires: float
    reading: bytes = b""


class TokensStated(Message):
    """Control lists for the api every usable token, at the start of a link and after every change."""

    tokens: list[TokenKept]


class RestCalled(Message):
    """A REST call to be recorded. `who` is the token's name, empty for an invalid token.

    `count` equal calls (of one second at least) are one message; `duration_us` is of the first. `dry`: a dry run.
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
    """The api's first message: the pin of its key (`sha256//…`), empty in clear text."""

    pin: Annotated[str, msgspec.Meta(pattern="^(sha256//[A-Za-z0-9+/]{43}=)?$")]


ApiLink = RequestMade | RequestWithdrawn | RequestAnswered | TokensStated | RestCalled | RestServed
