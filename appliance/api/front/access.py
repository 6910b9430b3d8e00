"""Authenticate bearer tokens.

1. Before control's first list of tokens, clients are asked to try again: "revoked" would end their sessions.
2. The costly check (scrypt) runs in a thread, for one request at a time. A peer that keeps sending wrong tokens must
   wait between checks.
3. A valid token is remembered only as a hash under a random key of this process, until the list changes.
4. The use of a token is reported at once, and then at most once in `USE_SECONDS`.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import cast

from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets
from appliance.base import clock
from appliance.channel.answers.token_answers import TokenRole
from appliance.channel.messages.api import ClientRequest, TokenKept
from appliance.configuration.sections import is_loopback
from appliance.quotas.peers import peer_key
from appliance.quotas.pool import QuotaClass
from appliance.signing.bearer_secrets import is_hash_of
from appliance.signing.request_signing import reading_id
from appliance.store.access_tokens import is_secret, parse_token

USE_SECONDS = 60.0
_KNOWN_SECONDS = 900.0
_MAX_KNOWN = 1024
_BLOCKED = "this host is blocked by an operator"


@dataclass(frozen=True, slots=True)
class Bearer:
    """The owner of a request's token; `expires` is seconds since the epoch.

    `shown` is the token (or its reading key) that the request carries. `asked` is the request, unless it is a GET;
    `gone` is set when the client disconnects.
    """

    id: str
    name: str
    role: TokenRole
    expires: float
    shown: str
    asked: ClientRequest | None = None
    gone: "asyncio.Future[None] | None" = field(default=None, compare=False)

    @property
    def left_seconds(self) -> float:
        return round(max(0.0, self.expires - clock.wall()), 1)


class TokenAuthenticator:
    """Checks tokens, and at most `failures_per_minute` wrong ones of each peer.

    `used(id)` is called when a token was presented.
    """

    def __init__(self, failures_per_minute: int, used: Callable[[str], None]) -> None:
        self._used = used
        self._reported: dict[str, float] = {}  # by token: the time of the last report
        self._tokens: dict[str, TokenKept] = {}
        self._ends: dict[str, tuple[float, float]] = {}  # by token: its date, and seconds since the boot
        self._stated = False
        self._recognised: dict[bytes, str] = {}
        self._key = secrets.token_bytes(32)
        # Counted separately, so that a peer that tries random ids does not lock out a neighbour with a valid token.
        self._unknown = Buckets(failures_per_minute / 60, failures_per_minute)
        self._wrong = Buckets(failures_per_minute / 60, failures_per_minute)
        self._checking = asyncio.Lock()
        self._of_token: dict[str, asyncio.Lock] = {}
        self._blocked: frozenset[str] = frozenset()
        self._shown: OrderedDict[str, float] = OrderedDict()  # by peer: the time of its last valid token

    def quota_class(self, peer: str) -> QuotaClass:
        """Return the class of a peer; peers with a recent valid token, and the operator's machine, are known."""
        shown = self._shown.get(peer)
        lately = shown is not None and clock.now() - shown < _KNOWN_SECONDS
        return QuotaClass.REGISTERED if lately or is_loopback(peer) else QuotaClass.UNKNOWN

    def state(self, tokens: Iterable[TokenKept]) -> None:
        self._tokens = {token.id: token for token in tokens}
        # No step of the clock changes an end. Control states the tokens again when one has ended.
        dates = {token.id: token.expires for token in self._tokens.values() if not token.ended}
        boot = clock.wall() - clock.since_boot()
        known = {token: end for token, end in self._ends.items() if end[0] == dates.get(token)}
        self._ends = {token: (date, date - boot) for token, date in dates.items()} | known
        self._stated = True
        self._recognised.clear()
        self._reported.clear()
        self._of_token = {}

    def state_blocks(self, hosts: Iterable[str]) -> None:
        self._blocked = frozenset(hosts)

    def is_blocked(self, peer: str) -> bool:
        return bool(self._blocked) and plain_address(peer) in self._blocked

    def require_unblocked(self, peer: str) -> None:
        """Raise `ProblemError` (403) if an operator blocks the peer."""
        if self.is_blocked(peer):
            raise ProblemError(403, "host-blocked", _BLOCKED)

    def end_of(self, bearer: Bearer, peer: str) -> str:
        """Return why a long answer must end, or an empty text."""
        if self.is_blocked(peer):
            return _BLOCKED
        return "" if self._lasts(bearer.id) else "the token has expired"

    def _lasts(self, token: str) -> bool:
        return clock.since_boot() < self._ends.get(token, (0.0, 0.0))[1]

    def recognised(self, authorization: str | None) -> str:
        """Return the id of a valid token that needs no costly check, or an empty text."""
        text = _token_in(authorization)
        parsed = parse_token(text)
        kept = self._tokens.get(parsed[0] if parsed is not None else reading_id(text) or "")
        if kept is None or not self._lasts(kept.id):
            return ""
        if parsed is None:
            return kept.id if is_hash_of(text, kept.reading) else ""
        return self._recognised.get(self._digest(text), "")

    async def recognise(self, authorization: str | None, host: str) -> Bearer:
        """Return the bearer. Raises `ProblemError` (401, 429, 503)."""
        text = _token_in(authorization)
        if not text:
            raise self._refusal("no token: send it (or its reading key) as `Authorization: Bearer TOKEN`")
        if not self._stated:
            raise ProblemError(503, "not-available", "the appliance is starting: try again", retry_after=1)
        parsed = parse_token(text)
        kept = self._tokens.get(parsed[0] if parsed is not None else reading_id(text) or "")
        if kept is not None and (
            is_hash_of(text, kept.reading)
            if parsed is None
            else await self._matches(text, parsed[1], kept, host)
        ):
            if self._lasts(kept.id):
                self._remember(peer_key(host))
                self._report_use(kept.id)
                return Bearer(kept.id, kept.name, cast(TokenRole, kept.role), kept.expires, text)
            end = datetime.fromtimestamp(kept.expires, UTC).isoformat(sep=" ", timespec="seconds")
            raise self._refusal(
                f"the token {kept.name} ended at {end}: ask an admin for a new one (rosrv token add)"
            )
        failures = self._unknown if kept is None else self._wrong
        _require_patience(failures, host)
        failures.take(host, clock.now())
        raise self._refusal("the token is wrong or revoked")

    async def _matches(self, text: str, secret: str, kept: TokenKept, host: str) -> bool:
        digest = self._digest(text)
        if self._recognised.get(digest) == kept.id:
            return True
        _require_patience(self._wrong, host)
        # One request of each token waits for the slow check, so that a token with many requests delays no other.
        async with self._of_token.setdefault(kept.id, asyncio.Lock()), self._checking:
            if self._recognised.get(digest) == kept.id:
                return True
            _require_patience(self._wrong, host)  # others of this host may have failed while it waited
            if not await asyncio.to_thread(is_secret, secret, kept.salt, kept.hash):
                return False
        if kept.id in self._tokens:
            self._recognised[digest] = kept.id
        return True

    def _digest(self, text: str) -> bytes:
        return hmac.digest(self._key, text.encode("ascii"), hashlib.sha256)

    def require_patience(self, host: str) -> None:
        """Raise `ProblemError` (429) if a peer sent too many wrong secrets."""
        _require_patience(self._unknown, host)

    def note_attempt(self, host: str, *, valid: bool) -> None:
        if valid:
            self._remember(peer_key(host))
        else:
            self._unknown.take(host, clock.now())

    def _remember(self, peer: str) -> None:
        self._shown[peer] = clock.now()
        self._shown.move_to_end(peer)
        if len(self._shown) > _MAX_KNOWN:
            self._shown.popitem(last=False)

    def _report_use(self, token: str) -> None:
        now = clock.now()
        if now - self._reported.get(token, -USE_SECONDS) >= USE_SECONDS:
            self._reported[token] = now
            self._used(token)

    def _refusal(self, detail: str) -> ProblemError:
        return ProblemError(
            401, "not-recognised", detail, headers={"WWW-Authenticate": 'Bearer realm="rosrv"'}
        )


def _token_in(authorization: str | None) -> str:
    scheme, _space, text = (authorization or "").partition(" ")
    return text.strip() if scheme.lower() == "bearer" else ""


def _require_patience(failures: Buckets, host: str) -> None:
    seconds = failures.wait(host, clock.now())
    if seconds:
        text = "too many requests from this host came without a valid token"
        raise too_many("too-many-failures", text, seconds)


def plain_address(peer: str) -> str:
    """Return an address in the form of the blocks: IPv4 even if the socket is IPv6."""
    address = ipaddress.ip_address(peer.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)
