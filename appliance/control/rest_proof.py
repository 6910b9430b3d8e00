"""Whose asking a request over REST is: found out in control, from what the client showed, never from the api's word.

The api is the process that browsers and scripts talk to; a stranger may have taken it over. Invariants:

1. Nothing is told or done in the name of a token without the token itself, or its reading key, beside the request:
   names are not asked for. An api that fell has nothing of a token that it was not shown since.
2. A change comes with the HTTP request that asked for it, and is what that request means (`rest_meaning.py`).
3. A change by a reading key comes with a proof: the request signed by the token's signing key, under a challenge of
   this process that is good once. An api that fell can carry such an order or drop it; it cannot change a byte of
   it, repeat it, or make one.
4. A bare token is proof for whatever whoever saw it says: the setting `api_require_proof` takes none for a change.
5. What is refused here is recorded by whoever calls, and nothing of it was done.
"""

import asyncio
import hashlib
import time

from appliance.audit.record import Severity
from appliance.channel import admin
from appliance.channel.answers.token_answers import Challenge, TokenRole, may
from appliance.channel.messages.api import Asked, RequestMade
from appliance.control.challenges import SECONDS, ChallengeRefusedError, Challenges
from appliance.control.rest_meaning import NoOrderError, meant
from appliance.control.token_orders import Tokens
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
    """Nothing is done; the text says why. `who` is the token's name where it was shown."""

    def __init__(self, text: str, who: str = "", severity: Severity = Severity.WARNING) -> None:
        super().__init__(text)
        self.who = who
        self.severity = severity


class Askers:
    """Finds out who asks; `require_proof`: a bare token changes nothing."""

    def __init__(self, tokens: Tokens, *, require_proof: bool) -> None:
        self._tokens = tokens
        self._require_proof = require_proof
        self._challenges = Challenges()
        # Of tokens without keys: SHA-256 of texts that scrypt has found right, by id; it runs once at a time.
        self._checked: dict[str, bytes] = {}
        self._checking = asyncio.Lock()

    def challenge(self) -> Challenge:
        """What the next order is signed under, and how long it is good."""
        return Challenge(self._challenges.give(time.monotonic()), SECONDS)

    async def asker(self, made: RequestMade) -> str:
        """The name of the token in whose name this is asked. Raises `UnprovenError`."""
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
        """The token that was shown, itself or by its reading key, and can be used now."""
        parsed = parse_token(shown)
        token_id = parsed[0] if parsed is not None else reading_id(shown)
        row = self._tokens.usable_row(token_id) if token_id is not None else None
        if row is not None:
            if parsed is None:
                good = row.keys is not None and reading_hash(shown) == row.keys.reading
            else:
                good = await self._is_token(shown, parsed[1], row)
            if good and self._tokens.usable_row(row.id) is not None:  # it may have ended meanwhile
                return row
        raise UnprovenError("no token that can be used was shown")

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
            raise UnprovenError("an order without the request that asked for it", row.name, Severity.ALARM)
        if asked.proof:
            self._require_proof_of(asked, row)
        elif reading_id(made.shown) is not None:
            raise UnprovenError(f"a change by a reading key needs its proof ({HEADER})", row.name)
        elif self._require_proof:
            text = f"a bare token changes nothing here (api_require_proof): sign the order ({HEADER})"
            raise UnprovenError(text, row.name)
        try:
            order = meant(asked, made.request)
        except NoOrderError as error:
            raise UnprovenError(f"not what was asked: {error}", row.name, Severity.ALARM) from None
        if order != made.request:
            text = f"{asked.method} {asked.target[:200]} does not mean this order"
            raise UnprovenError(text, row.name, Severity.ALARM)

    def _require_proof_of(self, asked: Asked, row: TokenRow) -> None:
        if row.keys is None:
            raise UnprovenError("this token is of a version without proofs: make another one", row.name)
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
                raise BadProofError("the proof is not of this request: it was signed otherwise")
            self._challenges.take(challenge, time.monotonic())
        except (BadProofError, ChallengeRefusedError) as error:
            raise UnprovenError(str(error), row.name) from None


def _role_for(request: admin.RestRequest) -> TokenRole | None:
    """The least role of a token that may ask this; None where no token is needed."""
    if isinstance(request, admin.MonitorReload) and request.prune:
        return "admin"  # removes what an admin loaded
    operation = admin.operation_of(request)
    return operation.role if operation is not None else "admin"
