"""Make, rotate, list and revoke the access tokens of REST.

The api gets data to recognise tokens, but never their secrets; if compromised, it can report wrong uses. A session
never replaces the token with its id.
"""

import contextlib
from collections.abc import Callable, Mapping
from typing import Protocol, cast

from msgspec import structs

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers import token_answers as answers
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.messages.api import TokenKept
from appliance.control.errors import TokenRefusedError
from appliance.store.access_tokens import BadTokenNameError, TokenRow, make_token
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

# Define people's sessions, which a feature that signs people in offers to the rest of control.
#
# A session is a token that a person's browser made for itself, so roles, quotas, orders and records treat both alike.


class Sessions(Protocol):
    """The sessions of this control process; they end with it."""

    def rows(self) -> list[TokenRow]:
        """Return the usable sessions as rows of tokens."""

    def of(self, session_id: str) -> SignedOn | None:
        """Return the session, or None if it has ended."""


TOKENS = EndKind("token", dated=True)
FIRST_NAME = "first"
_UNTOLD = "first token untold"  # this setting exists while the first token has not been shown
_USES_SINCE = "token uses since"
_LEAST_SECONDS = 30.0  # between two stored uses of a token; an api that works reports one a minute
DEFAULT_SECONDS = 90 * 86_400.0
LONGEST_SECONDS = 3650 * 86_400.0
_MAX = 1000
_MAX_ENDED = 100
_WARNED_SECONDS = 7 * 86_400.0
_SAME_DATE = 2.0  # seconds; a smaller difference is not shown


class TokenOrders:
    """All tokens. `changed()` is called when the usable tokens have changed."""

    def __init__(
        self,
        store: StateStore,
        trail: AuditTrail,
        ends: EndTable,
        changed: Callable[[], None],
        *,
        sessions: Callable[[], Sessions | None] = lambda: None,
    ) -> None:
        self._store = store
        self._trail = trail
        self._sessions = sessions
        self._ends = ends
        self._rows = {row.id: row for row in store.tokens()}
        settings = store.settings()
        self._untold = bool(settings.get(_UNTOLD))
        self._uses = store.token_uses()
        self._stored: dict[str, float] = {}  # by token: when its last use was stored (monotonic)
        self._uses_since = float(settings.get(_USES_SINCE) or clock.wall())
        if _USES_SINCE not in settings:
            store.save_setting(_USES_SINCE, str(self._uses_since))
        self._rotating: set[str] = set()  # names
        self._changed = changed
        ends.when_due(TOKENS, self._due)

    async def list_tokens(self, _request: admin.TokenList) -> answers.Tokens:
        return answers.Tokens([self._show(row) for row in self._rows.values()], self._uses_since)

    def usable(self) -> list[TokenKept]:
        """Return the usable tokens, as the api gets them; the api also checks `expires`."""
        tokens = {row.id: self._date(row) for row in self._rows.values() if self._is_usable(row)}
        return [kept_by_api(row) for row in ({row.id: row for row in self._session_rows()} | tokens).values()]

    def ended(self) -> list[TokenKept]:
        rows = [row for row in self._rows.values() if row.revoked is None and not self._is_usable(row)]
        latest = sorted(rows, key=lambda row: row.expires)[-_MAX_ENDED:]
        return [structs.replace(kept_by_api(row), ended=True) for row in latest]

    def ending(self) -> list[answers.TokenEnding]:
        """Return the tokens that end within a week, unless they were made for a short time or are rotated."""
        usable = [row for row in self._rows.values() if self._is_usable(row)]
        lasting = {row.name: row for row in sorted(usable, key=lambda row: row.expires)}
        return [
            answers.TokenEnding(row.name, cast(answers.TokenRole, row.role), self._date(row).expires)
            for row in lasting.values()
            if row.expires - row.created >= 2 * _WARNED_SECONDS
            and (self._ends.time_left(TOKENS, row.id) or 0.0) < _WARNED_SECONDS
        ]

    def usable_row(self, token_id: str) -> TokenRow | None:
        row = self._rows.get(token_id)
        if row is not None and self._is_usable(row):
            return row
        return next((row for row in self._session_rows() if row.id == token_id), None)

    def _session_rows(self) -> list[TokenRow]:
        sessions = self._sessions()
        return [] if sessions is None else sessions.rows()

    def used(self, token_id: str) -> None:
        if token_id not in self._rows:
            return
        self._uses[token_id], now = clock.wall(), clock.now()
        if now - self._stored.get(token_id, -_LEAST_SECONDS) < _LEAST_SECONDS:
            return
        with contextlib.suppress(StoreError):  # the next use is stored
            self._store.database.require_room()
            self._store.save_token_use(token_id, self._uses[token_id])
            self._stored[token_id] = now

    async def first(self) -> str | None:
        if self._rows and not self._untold:
            return None
        self._untold = True
        self._store.save_setting(_UNTOLD, "yes")
        if self._named(FIRST_NAME):
            await self.revoke(admin.TokenRevoke(FIRST_NAME))
        return (await self.add(admin.TokenAdd(FIRST_NAME, "admin", DEFAULT_SECONDS))).token

    def first_token_shown(self) -> None:
        if self._untold:
            self._untold = False
            self._store.save_setting(_UNTOLD, "")

    async def add(self, request: admin.TokenAdd, who: str = "") -> answers.NewToken:
        """Make a token. `who` is empty at the first start. Raises `TokenRefusedError` and `StoreError`."""
        name, now = request.name, clock.wall()
        _require_lifetime(request.seconds)
        if self._named(name):
            raise TokenRefusedError(
                f"there is a token {name!r} already: rotate or revoke it, or choose another name"
            )
        self._require_room()
        try:
            row, text = make_token(name, request.role, now=now, seconds=request.seconds)
        except BadTokenNameError as error:
            raise TokenRefusedError(str(error)) from error
        self._keep({row: request.seconds})
        self._trail.happened(
            "token added",
            f"token {name} ({row.role}) was made",
            token=name,
            id=row.id,
            role=row.role,
            expires=row.expires,
            who=who or None,
        )
        try:
            await self._store.until_settled()
        except StoreError:  # the token's text was not shown, so end the token to free its name
            self._end(row, who)
            raise
        return answers.NewToken(*_fields(row), token=text)

    async def rotate(self, request: admin.TokenRotate, who: str = "") -> answers.RotatedToken:
        """Replace a name's tokens. Raises `TokenRefusedError` and `StoreError`."""
        name, now = request.name, clock.wall()
        earlier = self._require_named(name)
        last = max(earlier, key=lambda row: row.expires)
        seconds = last.expires - last.created if request.seconds is None else request.seconds
        _require_lifetime(seconds)
        if not 0 <= request.grace <= LONGEST_SECONDS:
            raise TokenRefusedError("the grace time is not a time: write 10m, 12h or 7d")
        if name in self._rotating:
            raise TokenRefusedError(f"another order rotates the token {name!r} now: rosrv token list")
        if request.grace:
            self._require_room()
        row, text = make_token(name, last.role, now=now, seconds=seconds)
        until = now + request.grace
        left = {one: self._ends.time_left(TOKENS, one.id) or 0.0 for one in earlier}
        ended = {
            one._replace(expires=min(one.expires, until))
            if request.grace
            else one._replace(revoked=now): min(seconds_left, request.grace)
            for one, seconds_left in left.items()
        }
        self._keep(ended | {row: seconds})
        self._trail.happened(
            "token rotated",
            f"token {name} ({row.role}) was rotated",
            token=name,
            id=row.id,
            role=row.role,
            expires=row.expires,
            earlier=[one.id for one in ended],
            earlier_until=until,
            who=who or None,
        )
        self._rotating.add(name)
        try:
            await self._store.until_settled()
        except StoreError:
            if self._rows[row.id] is row:  # not revoked since
                self._keep(left)
                self._end(row, who, "was not rotated; the earlier ones stay valid")
            raise
        finally:
            self._rotating.discard(name)
        return answers.RotatedToken(*_fields(row), token=text, earlier=[self._show(one) for one in ended])

    async def revoke(self, request: admin.TokenRevoke, who: str = "") -> answers.Token:
        """End a name's tokens. Raises `TokenRefusedError` and `StoreError`."""
        ended = [self._end(row, who) for row in self._require_named(request.name)]
        await self._store.until_settled()
        return self._show(ended[-1])

    def _end(self, row: TokenRow, who: str, reason: str = "was revoked") -> TokenRow:
        revoked = row._replace(revoked=clock.wall())
        self._keep({revoked: 0.0})
        self._trail.happened(
            "token revoked",
            f"token {row.name} ({row.role}) {reason}",
            token=row.name,
            id=row.id,
            role=row.role,
            expires=row.expires,
            who=who or None,
        )
        return revoked

    def _named(self, name: str) -> list[TokenRow]:
        return [row for row in self._rows.values() if row.name == name and self._is_usable(row)]

    def _require_named(self, name: str) -> list[TokenRow]:
        found = self._named(name)
        if not found:
            names = {row.name for row in self._rows.values() if self._is_usable(row)}
            known = ", ".join(sorted(names)) or "none"
            raise TokenRefusedError(f"there is no token {name[:80]!r} that is valid; there are: {known}")
        return found

    def _require_room(self) -> None:
        if sum(self._is_usable(row) for row in self._rows.values()) >= _MAX:
            raise TokenRefusedError(f"there are {_MAX} tokens already: revoke some")

    def _keep(self, rows: Mapping[TokenRow, float]) -> None:
        """Store tokens with the seconds that each has left; after a crash, either all are stored or none.

        A new token's end is stored before it, and the nearer end of an earlier one after it.
        """
        new = [row for row in rows if row.id not in self._rows]
        self._rows |= {row.id: row for row in rows}
        with self._store.database.together():
            for row in new:
                self._ends.set(TOKENS, row.id, rows[row])
            self._store.save_tokens(*rows)
            for row, seconds in rows.items():
                if row.revoked is None:
                    self._ends.set(TOKENS, row.id, seconds)
                else:
                    self._ends.forget(TOKENS, row.id)
        self._changed()

    def _due(self, ended: list[str]) -> None:
        self._ends.forget(TOKENS, *ended)
        self._changed()

    def _is_usable(self, row: TokenRow) -> bool:
        return row.revoked is None and not self._ends.is_over(TOKENS, row.id)

    def _date(self, row: TokenRow) -> TokenRow:
        """Return the token with its end by the present system clock."""
        date = self._ends.date(TOKENS, row.id)
        return row if date is None or abs(date - row.expires) < _SAME_DATE else row._replace(expires=date)

    def _show(self, row: TokenRow) -> answers.Token:
        return answers.Token(*_fields(self._date(row)), self._uses.get(row.id), self._is_usable(row))


def _require_lifetime(seconds: float) -> None:
    if not 0 < seconds <= LONGEST_SECONDS:
        raise TokenRefusedError(f"a token ends after at most {LONGEST_SECONDS / 86_400:.0f} days")


def _fields(row: TokenRow) -> tuple[str, str, answers.TokenRole, float, float, float | None]:
    return row.name, row.id, cast(answers.TokenRole, row.role), row.created, row.expires, row.revoked


def kept_by_api(row: TokenRow) -> TokenKept:
    reading = row.keys.reading if row.keys is not None else b""
    return TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires, reading)
