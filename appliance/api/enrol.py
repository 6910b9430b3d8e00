"""What a host asks for itself, without a bearer token: to be enrolled, to have its certificate renewed, the lists.

Invariants:

1. Enrolment takes a one-time token and nothing else for who asks; a host that brings wrong ones has to wait, and
   all hosts together may bring only so many a minute. Whoever brought no wrong one is not made to wait for those who
   did: a stranger with many addresses cannot keep a host with a good token out.
2. Renewal is only for a host in its tunnel: control holds the peer's address against the virtual address of the
   name, which the firewall lets come through IPsec alone, and the signer checks the signature of its present key.
3. Signing requests are not parsed here.
"""

import base64
import binascii
import time
from typing import Annotated

from fastapi import Header, Request, Response
from msgspec import convert
from msgspec.structs import asdict

from appliance.api.host_routes import SLOW_SECONDS, OneName
from appliance.api.hosts_models import Enrolled, Enrolment, Renewal
from appliance.api.kits import Wishes, kit_of
from appliance.api.problems import ProblemError, too_many
from appliance.api.rates import Buckets
from appliance.api.route_roles import answered
from appliance.api.routing import Responses, Routes, answer, body, content, file
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.admin import A, AdminRequest
from appliance.channel.answers.host_answers import NewCertificate
from appliance.ipsec.enrolment_kit import archive, members

_ALL = "all"
_ALL_PER_MINUTE = 60
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_KIT: Responses = {
    200: {
        "description": "Enrolled; with `Accept: application/gzip` the kit as an archive",
        "content": content(Enrolled) | _ARCHIVE,
    },
    403: {"description": "The token is wrong, was used, or has ended."},
    503: {"description": "The appliance cannot answer now."},
}
_TUNNEL: Responses = {
    403: {"description": "Not from this host's tunnel, or not signed by its key."},
    503: {"description": "The appliance cannot answer now."},
}
_PEM: Responses = file("application/x-pem-file", "PEM") | {
    503: {"description": "The appliance cannot answer now."}
}


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(tags=["hosts"])
    _add_enrolment(router, services)
    _add_renewal(router, services)
    return router


def _add_enrolment(router: Routes, services: Services) -> None:
    patience = _Patience(services.settings.api_limits.failures_per_minute)

    @router.post("/v1/enrol", responses=_KIT, response_class=Response)
    async def enrol(
        brought: Annotated[Enrolment, body(Enrolment)],
        request: Request,
        accept: Annotated[str, Header(max_length=200)] = "application/json",
    ) -> Response:
        """Enrol a host by its one-time token and a signing request for the key it made; no bearer token."""
        peer = _peer(request)
        patience.require(peer)
        try:
            parts = await _ask(services, admin.HostEnrol(brought.token, brought.request, peer))
        except ProblemError as problem:
            if problem.status == 403:
                patience.failed(peer)
            raise
        kit = kit_of(parts, Wishes.of(parts.kept), None)
        if "application/gzip" in accept:
            return Response(archive(kit), media_type="application/gzip")
        files = {path: text for path, text, _mode in members(kit)}
        return answer(convert(asdict(parts) | {"files": files}, Enrolled))


def _add_renewal(router: Routes, services: Services) -> None:
    @router.post("/v1/hosts/{name}/renew", operation_id="renew_host", responses=_TUNNEL)
    async def renew(
        name: OneName, renewal: Annotated[Renewal, body(Renewal)], request: Request
    ) -> NewCertificate:
        """For a host in its tunnel: a certificate for a new key, asked for by its present key."""
        try:
            proof = base64.b64decode(renewal.proof, validate=True)
        except binascii.Error as error:
            raise ProblemError(422, "bad-input", f"body.proof: not base64: {error}") from None
        return await _ask(services, admin.HostRenewItself(name, renewal.request, proof, _peer(request)))

    @router.post(
        "/v1/hosts/{name}/renewed",
        operation_id="host_renewed",
        responses=_TUNNEL,
        response_class=Response,
        status_code=204,
    )
    async def renewed(name: OneName, request: Request) -> None:
        """For a host in its tunnel: the new certificate is in place; the one before ends, the tunnel comes anew."""
        await _ask(services, admin.HostRenewed(name, _peer(request)))

    @router.get("/v1/revocations", responses=_PEM, response_class=Response)
    async def revocations() -> Response:
        """The signed list of revoked certificates (CRL)."""
        listed = await _ask(services, admin.RevocationsWanted())
        return Response(listed.revocations, media_type="application/x-pem-file")

    @router.get("/v1/authority", responses=_PEM, response_class=Response)
    async def authority() -> Response:
        """The certificate of the appliance's authority."""
        own = await _ask(services, admin.AuthorityWanted())
        return Response(own.authority, media_type="application/x-pem-file")


class _Patience:
    """How many wrong tokens are looked at: of one host, and of all."""

    def __init__(self, per_minute: int) -> None:
        self._one = Buckets(per_minute / 60, per_minute)
        # Hosts are as many as an attacker has addresses.
        self._all = Buckets(max(per_minute, _ALL_PER_MINUTE) / 60, max(per_minute, _ALL_PER_MINUTE), peers=1)

    def require(self, peer: str) -> None:
        """Raises `ProblemError` (429)."""
        now = time.monotonic()
        seconds = self._one.wait(peer, now)
        if self._one.touched(peer, now):
            seconds = max(seconds, self._all.wait(_ALL, now))
        if seconds:
            raise too_many("too-many-failures", "too many wrong enrolment tokens were brought", seconds)

    def failed(self, peer: str) -> None:
        """A wrong token was brought."""
        now = time.monotonic()
        self._one.take(peer, now)
        self._all.take(_ALL, now)


async def _ask(services: Services, order: AdminRequest[A]) -> A:
    answer = await services.control.ask(order, None, SLOW_SECONDS)
    if not answer.ok and answer.trouble == "forbidden":
        raise ProblemError(403, "not-recognised", answer.error)
    return answered(answer)


def _peer(request: Request) -> str:
    assert request.client is not None  # noqa: S101  every peer of a TCP listener has an address
    return request.client.host
