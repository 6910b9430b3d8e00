"""`/v1/sso/begin` and `/v1/sso/complete`: a browser signs in without a token.

Sign-ons that are not completed count against the limit of their address, and few run at once, so neither an unknown
host nor a slow provider occupies control. No answer redirects, and nothing in a request becomes a part of a URL's host.
"""

import base64
from typing import Annotated

import msgspec
from fastapi import Request

from appliance.api.front.route_roles import answered
from appliance.api.front.routing import Responses, Routes, body
from appliance.api.front.services import Services
from appliance.api.front.streams import peer_of
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_bodies import WHOLE
from appliance.features.sso.link import SessionKeys
from appliance.features.sso.places import SignOnPlaces, SignOnRates
from appliance.features.sso.requests import SignedOn, SignOnBegin, SignOnComplete, SignOnPlace

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
            return answered(await services.control.ask(SignOnBegin(keys, peer, brought.again), None))

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
        return answered(answer)

    return router


def _bytes(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=")
