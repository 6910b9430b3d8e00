"""The link control <-> api. The api asks on behalf of a token.

What it may ask is the union `RestRequest`, which has no way to make a token.
"""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminAnswer, RestRequest
from appliance.channel.messages.message import Message


class RequestMade(Message):
    """The api passes on what the holder of the token `who` asks; `number` pairs it with its answer."""

    number: int
    who: str
    request: RestRequest


class RequestAnswered(Message):
    """Control's answer to `RequestMade` with the same number."""

    number: int
    answer: AdminAnswer


class TokenKept(msgspec.Struct, frozen=True):
    """A token that may be used, without its secret; `expires` is seconds since the epoch."""

    id: str
    name: str
    role: str
    salt: bytes
    hash: bytes
    expires: float


class TokensStated(Message):
    """Control tells the api every token that may be used; said at the start of a link and after every change."""

    tokens: list[TokenKept]


class RestCalled(Message):
    """A REST call to be recorded. `who` is the token's name, empty when nobody was recognised.

    `count` equal calls (of one second at least) are one message; `duration_us` is of the first.
    """

    host: str
    who: str
    method: str
    path: str
    status: int
    reason: str
    duration_us: int
    count: int = 1


class RestServed(Message):
    """The api says first by what it is recognised: the pin of its key (`sha256//…`), empty in clear text."""

    pin: Annotated[str, msgspec.Meta(pattern="^(sha256//[A-Za-z0-9+/]{43}=)?$")]


ApiLink = RequestMade | RequestAnswered | TokensStated | RestCalled | RestServed
