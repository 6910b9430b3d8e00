"""`/v1/sso/begin` and `/v1/sso/complete`: a browser signs in without a token.

Sign-ons that are not completed count against the limit of their address, and few run at once, so neither an unknown
host nor a slow provider occupies control. No answer redirects, and nothing in a request becomes a part of a URL's host.
"""

import asyncio
import base64
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

import msgspec
from fastapi import Request

from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets
from appliance.api.front.route_roles import unwrap
from appliance.api.front.routing import Responses, Routes, body
from appliance.api.front.services import Services
from appliance.api.front.streams import peer_of
from appliance.base import clock
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.rest_bodies import WHOLE
from appliance.features.sso.link import SessionKeys
from appliance.features.sso.requests import SignOnBegin, SignOnComplete, SignOnPlace
from appliance.quotas.peers import peer_key

# Limit the sign-ons of each address, and those that run at once.
#
# 1. A sign-on counts from its beginning until it succeeds; a failed one counts too. So many people behind one address
#    can sign in, and an unknown host can neither begin nor try many.
# 2. While all places are taken, the next free one goes to the address that has fewest, then to the one that has used
#    them least. Without a queue, no address waits.

MAX_AT_ONCE = 6  # of the 16 requests that may wait for other processes
MAX_WAITING = 64
WAITING_SECONDS = 10.0
_REMEMBERED = 1024  # addresses


class SignOnRates:
    """The sign-ons that each address has begun and not completed, and those that failed."""

    def __init__(self, per_minute: int) -> None:
        self._begun, self._failed = (Buckets(per_minute / 60, per_minute) for _ in range(2))

    def begin(self, peer: str) -> None:
        self.require_no_failures(peer)
        if seconds := self._begun.take(peer, clock.now()):
            raise too_many("too-many-failures", "too many sign-ins from this host are not completed", seconds)

    def require_no_failures(self, peer: str) -> None:
        if seconds := self._failed.wait(peer, clock.now()):
            raise too_many("too-many-failures", "too many sign-ins from this host failed", seconds)

    def failed(self, peer: str) -> None:
        self._failed.take(peer, clock.now())

    def succeeded(self, began_at: str) -> None:
        self._begun.give_back(began_at, clock.now())


class SignOnPlaces:
    """The sign-ons that run at once."""

    def __init__(self) -> None:
        self._running: Counter[str] = Counter()
        self._waiting: list[tuple[str, asyncio.Future[None]]] = []  # oldest first
        self._used: OrderedDict[str, float] = OrderedDict()  # seconds of each address

    @asynccontextmanager
    async def place(self, peer: str) -> AsyncIterator[None]:
        key = peer_key(peer)
        if self._running.total() < MAX_AT_ONCE:
            self._running[key] += 1
        else:
            await self._wait(key)
        began = clock.now()
        try:
            yield
        finally:
            self._leave(key, clock.now() - began)

    async def _wait(self, key: str) -> None:
        self._make_room(key)
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((key, turn))
        try:
            async with asyncio.timeout(WAITING_SECONDS):
                await turn
        except BaseException as error:
            if turn.done() and not turn.cancelled() and turn.exception() is None:
                self._leave(key, 0.0)  # it had just got the place
            if isinstance(error, TimeoutError):
                raise _busy() from None
            raise
        finally:
            self._waiting = [one for one in self._waiting if one[1] is not turn]

    def _make_room(self, key: str) -> None:
        if len(self._waiting) < MAX_WAITING:
            return
        waiting = Counter(one for one, _ in self._waiting)
        other, most = waiting.most_common(1)[0]
        if most <= waiting[key] + 1:
            raise _busy()
        turn = next(turn for one, turn in reversed(self._waiting) if one == other)
        if not turn.done():
            turn.set_exception(_busy())

    def _leave(self, key: str, seconds: float) -> None:
        self._running[key] -= 1
        self._running += Counter()  # without those that have none
        self._used[key] = self._used.pop(key, 0.0) + seconds
        if len(self._used) > _REMEMBERED:
            self._used.popitem(last=False)
        present = [(one, turn) for one, turn in self._waiting if not turn.done()]
        if not present:
            return
        next_key, turn = min(present, key=lambda one: (self._running[one[0]], self._used.get(one[0], 0.0)))
        self._running[next_key] += 1
        turn.set_result(None)


def _busy() -> ProblemError:
    return ProblemError(503, "busy", "too many people sign in at once: try again", retry_after=5)


_KEY = r"^[A-Za-z0-9_-]{43}$"
_FAILS: Responses = {
    404: {"description": "This appliance has no provider (`sso.issuer`)."},
    503: {"description": "The provider or the appliance cannot answer now."},
}


class BrowserKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A session that the browser made: a token's id, and the verifiers of its keys."""

    id: Annotated[str, doc("its unique id", pattern=r"^[0-9a-f]{12}$" + WHOLE)]
    reading: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("SHA-256 of the reading key, base64url")]
    verifying: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("public signing key, base64url")]
    again: Annotated[bool, doc("the person must prove to the provider again who they are")] = False


class Returned(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parameters with which the provider sent the browser back; `iss` may be empty."""

    state: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("as the browser got it when it began")]
    code: Annotated[str, msgspec.Meta(min_length=1, max_length=4096), doc("the provider's code")]
    iss: Annotated[str, msgspec.Meta(max_length=2048), doc("the provider's issuer, if it sends one")] = ""


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1/sso", tags=["tokens"])
    rates, places = SignOnRates(services.settings.api_limits.failures_per_minute), SignOnPlaces()

    @router.post("/begin", operation_id="begin_sign_on", responses=_FAILS)
    async def begin(brought: Annotated[BrowserKeys, body(BrowserKeys)], request: Request) -> SignOnPlace:
        """Begin to sign in at the provider; no bearer token. The browser has already made the keys of its session."""
        peer = peer_of(request)
        keys = SessionKeys(brought.id, _bytes(brought.reading), _bytes(brought.verifying))
        rates.begin(peer)
        async with places.place(peer):
            return unwrap(await services.control.ask(SignOnBegin(keys, peer, brought.again), None))

    @router.post("/complete", operation_id="complete_sign_on", responses=_FAILS)
    async def complete(returned: Annotated[Returned, body(Returned)], request: Request) -> SignedOn:
        """Complete a sign-in with the provider's code; no bearer token. The session's keys are then valid."""
        peer = peer_of(request)
        rates.require_no_failures(peer)
        async with places.place(peer):
            order = SignOnComplete(returned.state, returned.code, returned.iss, peer)
            answer = await services.control.ask(order, None)
        if answer.ok:
            rates.succeeded(peer)
        elif answer.trouble == "refused":
            rates.failed(peer)
        return unwrap(answer)

    return router


def _bytes(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=")
