"""Authenticate REST requests in control by the client's credentials, never by the api's claim.

The api is the process that browsers and scripts talk to, and may be compromised. Invariants:

1. Every request must contain its token, or the token's reading key. A compromised api can use only tokens that it has
   received since.
2. A change comes with the client's HTTP request, and must equal the order derived from it (`channel/rest_meaning.py`).
3. A change by a reading key needs a proof: the request signed with the token's signing key, with a challenge of this
   process that is valid once. A compromised api can drop such an order; it cannot change, repeat or make one.
4. A bare token authorises all requests of anyone who has seen it, but no changes with the setting `api_require_proof`.
5. A request denied here has no effect; the caller records it.
"""

import asyncio
import hashlib
import time

import msgspec

from appliance.audit.record import Severity
from appliance.channel import admin
from appliance.channel.answers.token_answers import Challenge, TokenRole, may
from appliance.channel.messages.api import ClientRequest, RequestMade
from appliance.channel.rest_meaning import NoOrderError, filled_in, meant
from appliance.control.challenges import SECONDS, ChallengeRefusedError, Challenges
from appliance.control.token_orders import TokenOrders
from appliance.signing.request_signing import (
    HEADER,
    BadProofError,
    is_signed,
    keys_of,
    parse_proof,
    reading_hash,
    reading_id,
    statement,
)
from appliance.store.access_tokens import TokenRow, is_secret, parse_token

_ITSELF = "the host itself"


class UnprovenError(Exception):
    """The request is denied; the message has the reason. `who` is the name of the shown token, if any."""

    def __init__(self, text: str, who: str = "", severity: Severity = Severity.WARNING) -> None:
        super().__init__(text)
        self.who = who
        self.severity = severity


class RequestAuthenticator:
    """The authentication of requests by their tokens; `require_proof`: a bare token is not enough for changes."""

    def __init__(self, tokens: TokenOrders, *, require_proof: bool) -> None:
        self._tokens = tokens
        self._require_proof = require_proof
        self._challenges = Challenges()
        # For tokens without keys: SHA-256 of the texts that scrypt has accepted, by id; scrypt runs once at a time.
        self._checked: dict[str, bytes] = {}
        self._checking = asyncio.Lock()

    def challenge(self) -> Challenge:
        """Return a challenge for an order, and its lifetime."""
        return Challenge(self._challenges.give(time.monotonic()), SECONDS)

    async def asker(self, made: RequestMade) -> str:
        """Return the name of the request's token, or another author if none is needed. Raises `UnprovenError`."""
        role = _role_for(made.request)
        if role is None:
            return "" if isinstance(made.request, admin.MetricsWanted) else _ITSELF
        row = await self._holder(made.shown)
        if not may(row.role, role):
            raise UnprovenError(
                f"this is for {role}s; the token {row.name} has the role {row.role}", row.name
            )
        if type(made.request) in admin.CHANGES:
            self._require_order(made, row)
        return row.name

    async def _holder(self, shown: str) -> TokenRow:
        """Return the usable token that was shown, or whose reading key was. Raises `UnprovenError`."""
        parsed = parse_token(shown)
        token_id = parsed[0] if parsed is not None else reading_id(shown)
        row = self._tokens.usable_row(token_id) if token_id is not None else None
        if row is not None:
            if parsed is None:
                good = row.keys is not None and reading_hash(shown) == row.keys.reading
            else:
                good = await self._is_token(shown, parsed[1], row)
            if good and self._tokens.usable_row(row.id) is not None:  # it may have ended since
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
            order = filled_in(meant(asked), made.request)
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
            self._challenges.take(challenge, time.monotonic())
        except (BadProofError, ChallengeRefusedError) as error:
            raise UnprovenError(str(error), row.name) from None


def _role_for(request: admin.RestRequest) -> TokenRole | None:
    """Return the least role whose token authorises this request; None if no token is needed."""
    operation = admin.operation_of(request)
    if operation is None or operation.role is None:
        return None if operation is not None else "admin"
    return operation.least(msgspec.structs.asdict(request))[0]
