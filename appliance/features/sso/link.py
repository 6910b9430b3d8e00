"""The link control <-> sso."""

import msgspec

from appliance.channel.answers.token_answers import TokenRole
from appliance.channel.messages.message import Message


class SessionKeys(msgspec.Struct, frozen=True):
    """A session's id, which a browser chose, and the verifiers of its keys, as of a token."""

    id: str
    reading: bytes
    verifying: bytes


class SignedInPerson(msgspec.Struct, frozen=True):
    """A person; `ends` is seconds since the epoch.

    `subject` is the provider's `sub`. `mail` is empty unless it is verified. `doors` are groups of doors.
    """

    subject: str
    name: str
    mail: str
    role: TokenRole
    doors: tuple[str, ...]
    ends: float


class SignOnWanted(Message, frozen=True):
    """A browser begins to sign in; `again`: the person must prove who they are again."""

    number: int
    keys: SessionKeys
    address: str
    again: bool


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
    """The sign-on failed; `refused`: the person or the browser is not accepted, otherwise the provider fails."""

    number: int
    reason: str
    refused: bool


SsoLink = SignOnWanted | SignOnBegun | SignOnReturned | SignOnConfirmed | SignOnFailed
