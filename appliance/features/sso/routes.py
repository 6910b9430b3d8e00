"""`/v1/sso/begin` and `/v1/sso/complete`: a browser signs in without a token.

Both calls count against the limit of their address, and few run at once, so neither an unknown host nor a slow
provider occupies control. No answer redirects, and nothing in a request becomes a part of a URL's host.
"""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import msgspec
from fastapi import Request

from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets
from appliance.api.front.route_roles import answered
from appliance.api.front.routing import Responses, Routes, body
from appliance.api.front.services import Services
from appliance.api.front.streams import peer_of
from appliance.base import clock
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_bodies import WHOLE
from appliance.features.sso.link import SessionKeys
from appliance.features.sso.sso_requests import SignedOn, SignOnBegin, SignOnComplete, SignOnPlace

_MOST_AT_ONCE = 6  # of the 16 requests that may wait for other processes
_KEY = r"^[A-Za-z0-9_-]{43}$"
_FAILS: Responses = {
    404: {"description": "This appliance has no provider (`sso.issuer`)."},
    503: {"description": "The provider or the appliance cannot answer now."},
}


class BrowserKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A session that the browser made: a token's id, and the verifiers of its keys."""

    id: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{12}$" + WHOLE)]
    reading: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("SHA-256 of the reading key, base64url")]
    verifying: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("public signing key, base64url")]
    again: Annotated[bool, doc("the person must prove to the provider again who they are")] = False


class Returned(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parameters with which the provider sent the browser back; `iss` may be empty."""

    state: Annotated[str, msgspec.Meta(pattern=_KEY + WHOLE), doc("as the browser got it when it began")]
    code: Annotated[str, msgspec.Meta(min_length=1, max_length=4096), doc("the provider's code")]
    iss: Annotated[str, msgspec.Meta(max_length=2048), doc("the provider's issuer, if it sends one")] = ""


class _Limits:
    def __init__(self, per_minute: int) -> None:
        self._buckets = Buckets(per_minute / 60, per_minute)
        self._running = 0

    @contextmanager
    def place(self, peer: str) -> Iterator[None]:
        seconds = self._buckets.take(peer, clock.now())
        if seconds:
            raise too_many("too-many-failures", "too many sign-ins from this host", seconds)
        if self._running >= _MOST_AT_ONCE:
            raise ProblemError(503, "busy", "too many people sign in at once: try again", retry_after=5)
        self._running += 1
        try:
            yield
        finally:
            self._running -= 1


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1/sso", tags=["tokens"])
    limits = _Limits(services.settings.api_limits.failures_per_minute)

    @router.post("/begin", operation_id="begin_sign_on", responses=_FAILS)
    async def begin(brought: Annotated[BrowserKeys, body(BrowserKeys)], request: Request) -> SignOnPlace:
        """Begin to sign in at the provider; no bearer token. The browser has already made the keys of its session."""
        peer = peer_of(request)
        keys = SessionKeys(brought.id, _bytes(brought.reading), _bytes(brought.verifying))
        with limits.place(peer):
            return answered(await services.control.ask(SignOnBegin(keys, peer, brought.again), None))

    @router.post("/complete", operation_id="complete_sign_on", responses=_FAILS)
    async def complete(returned: Annotated[Returned, body(Returned)], request: Request) -> SignedOn:
        """Complete a sign-in with the provider's code; no bearer token. The session's keys are then valid."""
        peer = peer_of(request)
        with limits.place(peer):
            order = SignOnComplete(returned.state, returned.code, returned.iss, peer)
            return answered(await services.control.ask(order, None))

    return router


def _bytes(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=")
