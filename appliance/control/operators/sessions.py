"""Define people's sessions, which a feature that signs people in offers to the rest of control.

A session is a token that a person's browser made for itself, so roles, quotas, orders and records treat both alike.
"""

from typing import NamedTuple, Protocol

from appliance.channel.answers.token_answers import TokenRole
from appliance.store.access_tokens import TokenRow


class Session(NamedTuple):
    """A person who is signed in.

    `subject` is the provider's permanent identifier, and `mail` empty unless it is verified. `groups` select the
    person's door.
    """

    id: str
    name: str
    subject: str
    mail: str
    role: TokenRole
    groups: tuple[str, ...]
    expires: float


class Sessions(Protocol):
    """The sessions of this control process; they end with it."""

    def rows(self) -> list[TokenRow]:
        """Return the usable sessions as rows of tokens."""

    def of(self, session_id: str) -> Session | None:
        """Return the session, or None if it has ended."""
