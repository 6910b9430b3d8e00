"""Access tokens of REST, and what its orders are signed under."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, told

TokenRole = Literal["viewer", "investigator", "operator", "admin"]
"""Viewers look; investigators also fetch the messages of recordings, which nobody else may; operators take the file's
policy, or one that was in force before; admins bring new rules into force."""

_RANKS: dict[str, int] = {"viewer": 1, "investigator": 1, "operator": 2, "admin": 3}


def may(held: str, least: TokenRole) -> bool:
    """Whether a token of one role may do what is for another. What is for investigators nobody else may."""
    return held == least if least == "investigator" else _RANKS[held] >= _RANKS[least]


class Token(msgspec.Struct, frozen=True):
    """A token without its secret; times are seconds since the epoch."""

    name: str
    id: str
    role: TokenRole
    created: Moment
    expires: Moment
    revoked: Moment | None


class Tokens(msgspec.Struct, frozen=True):
    """All tokens that were made, the oldest first."""

    tokens: list[Token]


class NewToken(Token, frozen=True, kw_only=True):
    """A token that was made, with its text: the only place where that ever stands."""

    token: str


class Challenge(msgspec.Struct, frozen=True):
    """What the next order is signed under."""

    challenge: str
    seconds: Annotated[float, told("so long it is good, for one order")]
