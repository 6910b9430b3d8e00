"""The messages between control and the process `sso`."""

import msgspec

from appliance.channel.answers.token_answers import TokenRole
from appliance.channel.messages.message import Message


class SessionKeys(msgspec.Struct, frozen=True):
    """A session's id, which a browser chose, and the verifiers of its keys."""

    id: str
    reading: bytes
    verifying: bytes


class SignedInPerson(msgspec.Struct, frozen=True):
    """A person; `ends` is seconds since the epoch."""

    subject: str
    """The provider's `sub`."""
    name: str
    mail: str
    """Empty unless it is verified."""
    role: TokenRole
    doors: tuple[str, ...]
    """Groups of doors."""
    ends: float


class SignOnWanted(Message, frozen=True):
    """A browser begins to sign in."""

    number: int
    keys: SessionKeys
    address: str
    again: bool
    """Whether the person must prove who they are again."""


class SignOnBegun(Message, frozen=True):
    """The browser goes to this URL, and returns with `state`."""

    number: int
    url: str
    state: str


class SignOnReturned(Message, frozen=True):
    """A browser returned from the provider with a code."""

    number: int
    state: str
    code: str
    issuer: str


class SignOnConfirmed(Message, frozen=True):
    """The person who began with these keys at this address is identified."""

    number: int
    identity: SignedInPerson
    keys: SessionKeys
    address: str


class SignOnFailed(Message, frozen=True):
    """The sign-on failed."""

    number: int
    reason: str
    refused: bool
    """Whether the person or the browser is not accepted; otherwise the provider fails."""


SsoLink = SignOnWanted | SignOnBegun | SignOnReturned | SignOnConfirmed | SignOnFailed
