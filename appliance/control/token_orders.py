"""Make, list and revoke the access tokens of REST.

The api gets data to recognise tokens, but never their secrets. Every creation and revocation of a token is recorded.
"""

import time
from collections.abc import Callable
from typing import cast

from appliance.channel import admin
from appliance.channel.answers import token_answers as answers
from appliance.channel.messages.api import TokenKept
from appliance.store.access_tokens import BadTokenNameError, TokenRow, make_token
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

FIRST_NAME = "first"
_UNTOLD = "first token untold"  # this setting exists while the first token has not been shown
DEFAULT_SECONDS = 90 * 86_400.0
LONGEST_SECONDS = 3650 * 86_400.0
_MOST = 1000


class TokenRefusedError(Exception):
    """The token cannot be made or revoked; the message gives the reason."""


class TokenOrders:
    """All tokens. `changed()` is called when the usable tokens have changed."""

    def __init__(self, store: StateStore, trail: AuditTrail, changed: Callable[[], None]) -> None:
        self._store = store
        self._trail = trail
        self._rows = {row.id: row for row in store.tokens()}
        self._untold = bool(store.settings().get(_UNTOLD))
        self._changed = changed

    async def listed(self, _request: admin.TokenList) -> answers.Tokens:
        """Return all tokens, including ended ones, oldest first."""
        return answers.Tokens([answers.Token(*_fields(row)) for row in self._rows.values()])

    def usable(self) -> list[TokenKept]:
        """Return the data by which the api recognises tokens. The api checks `expires`."""
        now = time.time()
        return [
            TokenKept(
                row.id,
                row.name,
                row.role,
                row.salt,
                row.hash,
                row.expires,
                row.keys.reading if row.keys is not None else b"",
            )
            for row in self._rows.values()
            if row.usable(now)
        ]

    def usable_row(self, token_id: str) -> TokenRow | None:
        """Return the token with this id, if it is usable now."""
        row = self._rows.get(token_id)
        return row if row is not None and row.usable(time.time()) else None

    async def first(self) -> str | None:
        """Make a first token, if no token exists or if the first token was never shown. Return its text, or None."""
        if self._rows and not self._untold:
            return None
        self._untold = True
        self._store.save_setting(_UNTOLD, "yes")
        if self._named(FIRST_NAME, time.time()) is not None:
            await self.revoke(admin.TokenRevoke(FIRST_NAME))
        return (await self.add(admin.TokenAdd(FIRST_NAME, "admin", DEFAULT_SECONDS))).token

    def first_token_shown(self) -> None:
        """Store that the first token was shown to the person who started the appliance."""
        if self._untold:
            self._untold = False
            self._store.save_setting(_UNTOLD, "")

    async def add(self, request: admin.TokenAdd) -> answers.NewToken:
        """Make a token. Only this answer contains its text. Raises `TokenRefusedError` and `StoreError`."""
        name, seconds, now = request.name, request.seconds, time.time()
        if not 0 < seconds <= LONGEST_SECONDS:
            raise TokenRefusedError(f"a token ends after at most {LONGEST_SECONDS / 86_400:.0f} days")
        if self._named(name, now) is not None:
            raise TokenRefusedError(
                f"there is a token {name!r} already: revoke it first, or choose another name"
            )
        self._require_room(now)
        try:
            row, text = make_token(name, request.role, now=now, seconds=seconds)
        except BadTokenNameError as error:
            raise TokenRefusedError(str(error)) from error
        self._keep(row)
        self._trail.happened(
            "token added",
            f"token {row.name} ({row.role}) was made",
            token=row.name,
            id=row.id,
            role=row.role,
            expires=row.expires,
        )
        try:
            await self._store.settled()
        except StoreError:  # the token's text was not shown, so end the token to free its name
            self._end(row)
            raise
        return answers.NewToken(*_fields(row), token=text)

    async def revoke(self, request: admin.TokenRevoke) -> answers.Token:
        """End a token now. Raises `TokenRefusedError` and `StoreError`."""
        name, now = request.name, time.time()
        row = self._named(name, now)
        if row is None:
            known = (
                ", ".join(sorted(token.name for token in self._rows.values() if token.usable(now))) or "none"
            )
            raise TokenRefusedError(f"there is no token {name[:80]!r} that is valid; there are: {known}")
        revoked = self._end(row)
        await self._store.settled()
        return answers.Token(*_fields(revoked))

    def _end(self, row: TokenRow) -> TokenRow:
        revoked = row._replace(revoked=time.time())
        self._keep(revoked)
        self._trail.happened(
            "token revoked", f"token {row.name} ({row.role}) was revoked", token=row.name, id=row.id
        )
        return revoked

    def _named(self, name: str, now: float) -> TokenRow | None:
        return next((row for row in self._rows.values() if row.name == name and row.usable(now)), None)

    def _require_room(self, now: float) -> None:
        if sum(row.usable(now) for row in self._rows.values()) >= _MOST:
            raise TokenRefusedError(f"there are {_MOST} tokens already: revoke some")

    def _keep(self, row: TokenRow) -> None:
        self._rows[row.id] = row
        self._store.save_token(row)
        self._changed()


def _fields(row: TokenRow) -> tuple[str, str, answers.TokenRole, float, float, float | None]:
    return row.name, row.id, cast(answers.TokenRole, row.role), row.created, row.expires, row.revoked
