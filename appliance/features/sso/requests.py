"""Requests of single sign-on, and their answers."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.rest_bodies import WHOLE
from appliance.channel.rest_operation import parameter, rest
from appliance.features.sso.link import SessionKeys

_SESSION = "^[0-9a-f]{12}$"
EXCHANGE_SECONDS = 40.0  # discovery, the code's exchange and the keys, one after another


class SignOnPlace(msgspec.Struct, frozen=True):
    """The URL at the provider, to which the browser goes, and the `state` with which it returns."""

    url: Annotated[str, doc("address at the provider, to which the browser goes")]
    state: Annotated[str, doc("value with which the browser returns")]


class SignedOnList(msgspec.Struct, frozen=True):
    """The sessions of all people, oldest first."""

    sessions: Annotated[list[SignedOn], doc("oldest first")]


@rest(None, open_path="/v1/sso/begin", seconds=EXCHANGE_SECONDS)
class SignOnBegin(WaitingRequest[SignOnPlace], frozen=True, tag="sso begin"):
    """A browser at the address `peer` begins to sign in, with the verifiers of the keys of its session."""

    keys: SessionKeys
    peer: str
    again: bool = False


@rest(None, open_path="/v1/sso/complete", seconds=EXCHANGE_SECONDS)
class SignOnComplete(WaitingRequest[SignedOn], frozen=True, tag="sso complete"):
    """A browser at the address `peer` returned from the provider with a code."""

    state: str
    code: str
    issuer: str
    peer: str


@rest("admin", "GET", "/v1/sso/sessions", name="sso_sessions", tag="tokens")
class SessionsWanted(AdminRequest[SignedOnList], frozen=True, tag="sso list"):
    """The sessions of people who signed in at the provider. For admins."""


@rest(
    "viewer", "DELETE", "/v1/sso/sessions/{session}", name="sign_out", tag="tokens",
    problems={404: "This is not a session of the caller."},
)  # fmt: skip
class SignOut(AdminRequest[SignedOn], frozen=True, tag="sso sign out"):
    """End one of the caller's own sessions now."""

    session: Annotated[
        str, parameter("id of the session", pattern=_SESSION + WHOLE, examples=["5f0c2a9be417"])
    ]


@rest(
    "admin", "DELETE", "/v1/sso/people/{name}", name="end_sessions", tag="tokens",
    problems={404: "No person of this name is signed in."},
)  # fmt: skip
class SessionsEnd(AdminRequest[SignedOnList], frozen=True, tag="sso end"):
    """End all sessions of a person now. They can sign in again unless the provider refuses it. For admins."""

    name: Annotated[
        str, parameter("name of the person", min_length=1, max_length=140, examples=["sso:alice@example.org"])
    ]


REQUESTS = (SignOnBegin, SignOnComplete, SessionsWanted, SignOut, SessionsEnd)
