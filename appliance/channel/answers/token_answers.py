"""Access tokens of REST, and the challenges for signing orders."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Id, Moment, Name, doc

TokenRole = Literal["viewer", "investigator", "operator", "admin"]
"""Viewers read. Only investigators can also fetch the messages of recordings. Operators load the file's policy, or one
that was in force before. Admins bring new rules into force.
"""

_RANKS: dict[str, int] = {"viewer": 1, "investigator": 1, "operator": 2, "admin": 3}


def may(held: str, least: TokenRole) -> bool:
    """Return whether a role includes another; no other role includes `investigator`."""
    return held == least if least == "investigator" else _RANKS[held] >= _RANKS[least]


class TokenEnding(msgspec.Struct, frozen=True):
    """A token that ends within a week, without a later one of its name."""

    name: Name
    role: Annotated[TokenRole, doc("role, which decides its rights")]
    expires: Moment


class Token(msgspec.Struct, frozen=True):
    """A token without its secret; times are seconds since the epoch."""

    name: Name
    id: Id
    role: Annotated[TokenRole, doc("role, which decides its rights")]
    created: Moment
    expires: Moment
    revoked: Moment | None
    last_used: Annotated[
        Moment | None,
        doc("when it was last presented, to within a minute, or null if not since `uses_since`"),
    ] = None
    valid: Annotated[
        bool,
        doc("whether REST accepts it; a step back of the system time does not make an expired token valid"),
    ] = True


class Tokens(msgspec.Struct, frozen=True):
    """All tokens that were made, oldest first."""

    tokens: Annotated[list[Token], doc("all tokens, including ended ones")]
    uses_since: Annotated[
        Moment, doc("since when uses are known (seconds since the epoch): this state's first start")
    ]


class NewToken(Token, frozen=True, kw_only=True):
    """A new token with its text, which is shown only here."""

    token: str


class RotatedToken(NewToken, frozen=True, kw_only=True):
    """A new token that replaces the `earlier` tokens of its name, which are revoked or expire after the grace time."""

    earlier: list[Token]


class Challenge(msgspec.Struct, frozen=True):
    """The challenge under which the next order is signed."""

    challenge: Annotated[str, doc("the text under which the next order is signed")]
    seconds: Annotated[float, doc("seconds for which it is valid, for one order")]


class SignedOn(msgspec.Struct, frozen=True):
    """A session of a person; `mail` is empty unless the provider has verified it."""

    id: Annotated[str, doc("id of the session")]
    name: Annotated[str, doc("name of the person in the audit log")]
    subject: Annotated[str, doc("permanent identifier of the person at the provider (`sub`)")]
    mail: Annotated[str, doc("verified e-mail address, or empty without one")]
    role: Annotated[TokenRole, doc("role, which decides its rights")]
    groups: Annotated[list[str], doc("groups of doors")]
    expires: Moment
