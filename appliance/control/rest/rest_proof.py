"""Authenticate REST requests by the client's credentials, never by a claim of the api process.

Browsers and scripts connect to the api process, so it may be compromised.

1. A request must contain its token, or the token's reading key. A compromised api can use only the tokens that it has
   received since then.
2. A change must equal the order that control derives from the client's HTTP request (`channel/rest_meaning.py`).
3. A change by a reading key needs a proof: a signature of the HTTP request by the token's signing key, with a
   challenge that is valid once. A compromised api can drop such an order, but cannot change, repeat or forge it.
4. A bare token authorises requests of anyone who has seen it, but never changes if `api_require_proof` is set.
"""

import asyncio
import hashlib
import hmac
import secrets
from typing import Protocol

import msgspec

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.token_answers import Challenge, TokenRole, may
from appliance.channel.messages.api import ClientRequest, RequestMade
from appliance.channel.operations import CHANGES, RestRequest
from appliance.channel.rest_meaning import NoOrderError, filled_in, order_of
from appliance.signing.bearer_secrets import is_hash_of
from appliance.signing.request_signing import (
    HEADER,
    BadProofError,
    is_signed,
    keys_of,
    parse_proof,
    reading_id,
    statement,
)
from appliance.store.access_tokens import TokenRow, is_secret, parse_token

SECONDS = 60.0
_MAX_TAKEN = 4096


class ChallengeRefusedError(Exception):
    """The challenge of a proof is not accepted; the message gives the reason."""


class Challenges:
    """The challenges of this process, each accepted once; `now` is in seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)
        self._taken: dict[str, float] = {}  # accepted challenges, with the time at which they expire

    def give(self, now: float) -> str:
        begun = f"{now + SECONDS:.3f}.{secrets.token_urlsafe(16)}"
        return f"{begun}.{self._mac(begun)}"

    def take(self, challenge: str, now: float) -> None:
        begun, _dot, mac = challenge.rpartition(".")
        if not hmac.compare_digest(mac.encode(), self._mac(begun).encode()):
            raise ChallengeRefusedError(
                "RVMaster has not issued this challenge since it started: request another one"
            )
        ends = float(begun.rpartition(".")[0])
        if ends <= now:
            raise ChallengeRefusedError("the challenge has expired: request another one")
        if challenge in self._taken:
            raise ChallengeRefusedError("the proof was already used: each is valid once")
        for old in [taken for taken, end in self._taken.items() if end <= now]:
            del self._taken[old]
        if len(self._taken) >= _MAX_TAKEN:
            raise ChallengeRefusedError(f"{_MAX_TAKEN} orders were signed within {SECONDS:g} s: wait")
        self._taken[challenge] = ends

    def _mac(self, begun: str) -> str:
        return hmac.new(self._key, begun.encode(), hashlib.sha256).hexdigest()


_ITSELF = "the host itself"


class UnprovenError(Exception):
    """The request is denied; the message gives the reason. `who` is the name of the presented token, if any."""

    def __init__(self, text: str, who: str = "", severity: Severity = Severity.WARNING) -> None:
        super().__init__(text)
        self.who = who
        self.severity = severity


class UsableTokens(Protocol):
    """The tokens of this appliance."""

    def usable_row(self, token_id: str) -> TokenRow | None:
        """Return the token, if it is usable now."""


class RequestAuthenticator:
    """Authenticates requests. `require_proof`: a bare token is not enough for changes."""

    def __init__(self, tokens: UsableTokens, *, require_proof: bool) -> None:
        self._tokens = tokens
        self._require_proof = require_proof
        self._challenges = Challenges()
        # Tokens without keys are checked with slow scrypt, one at a time. This cache has the SHA-256 of accepted
        # tokens, by token id.
        self._checked: dict[str, bytes] = {}
        self._checking = asyncio.Lock()

    def challenge(self) -> Challenge:
        return Challenge(self._challenges.give(clock.now()), SECONDS)

    async def asker(self, made: RequestMade) -> str:
        """Return the name of the request's token, or a fixed name if it needs none. Raises `UnprovenError`."""
        role = _role_for(made.request)
        if role is None:
            return "" if isinstance(made.request, admin.MetricsWanted) else _ITSELF
        row = await self._holder(made.shown)
        if not may(row.role, role):
            raise UnprovenError(
                f"this is for {role}s; the token {row.name} has the role {row.role}", row.name
            )
        if type(made.request) in CHANGES:
            self._require_order(made, row)
        return row.name

    async def _holder(self, shown: str) -> TokenRow:
        """Return the row of a valid token or reading key. Raises `UnprovenError`."""
        parsed = parse_token(shown)
        token_id = parsed[0] if parsed is not None else reading_id(shown)
        row = self._tokens.usable_row(token_id) if token_id is not None else None
        if row is not None:
            if parsed is None:
                good = row.keys is not None and is_hash_of(shown, row.keys.reading)
            else:
                good = await self._is_token(shown, parsed[1], row)
            if good and self._tokens.usable_row(row.id) is not None:  # the token may have ended since
                return row
        raise UnprovenError("no valid token was presented")

    async def _is_token(self, shown: str, secret: str, row: TokenRow) -> bool:
        if row.keys is not None:
            return keys_of(shown) == row.keys
        digest = hashlib.sha256(shown.encode("ascii")).digest()
        async with self._checking:
            if self._checked.get(row.id) == digest:
                return True
            if not await asyncio.to_thread(is_secret, secret, row.salt, row.hash):
                return False
            self._checked[row.id] = digest
            return True

    def _require_order(self, made: RequestMade, row: TokenRow) -> None:
        asked = made.asked
        if asked is None:
            raise UnprovenError("an order without its HTTP request", row.name, Severity.ALARM)
        if asked.proof:
            self._require_proof_of(asked, row)
        elif reading_id(made.shown) is not None:
            raise UnprovenError(f"a change by a reading key needs its proof ({HEADER})", row.name)
        elif self._require_proof:
            text = f"a bare token changes nothing here (api_require_proof): sign the order ({HEADER})"
            raise UnprovenError(text, row.name)
        try:
            order = filled_in(order_of(asked), made.request)
        except NoOrderError as error:
            raise UnprovenError(
                f"the order does not match its request: {error}", row.name, Severity.ALARM
            ) from None
        if order != made.request:
            text = f"{asked.method} {asked.target[:200]} does not request this order"
            raise UnprovenError(text, row.name, Severity.ALARM)

    def _require_proof_of(self, asked: ClientRequest, row: TokenRow) -> None:
        if row.keys is None:
            raise UnprovenError("this token is from a version without proofs: create another one", row.name)
        try:
            challenge, signature = parse_proof(asked.proof)
            stated = statement(
                challenge,
                method=asked.method,
                target=asked.target,
                if_match=asked.if_match,
                content_type=asked.content_type,
                body=asked.body,
            )
            if not is_signed(row.keys.verifying, stated, signature):
                raise BadProofError("the proof does not fit this request: another request was signed")
            self._challenges.take(challenge, clock.now())
        except (BadProofError, ChallengeRefusedError) as error:
            raise UnprovenError(str(error), row.name) from None


def _role_for(request: RestRequest) -> TokenRole | None:
    operation = admin.operation_of(request)
    if operation is None or operation.role is None:
        return None if operation is not None else "admin"
    return operation.least(msgspec.structs.asdict(request))[0]
