"""Answer a host's own requests, without a bearer token: enrolment, renewal, authority, revocations.

1. A host that sends wrong tokens must wait, and all such hosts share one limit. A host that sent no wrong token never
   waits, so an attacker with many addresses cannot keep out a valid token.
2. Only a host in its tunnel can renew (`enrolment.py`).
3. Signing requests are not parsed here: only the signer does so.
"""

import base64
import binascii
from typing import Annotated

import msgspec
from fastapi import Header, Request, Response
from msgspec import convert
from msgspec.structs import asdict

from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets
from appliance.api.front.route_roles import answered
from appliance.api.front.routing import Responses, Routes, answer, body, content, file
from appliance.api.front.services import Services
from appliance.api.front.streams import peer_of
from appliance.api.routes.operation_routes import AnsweringRoutes
from appliance.base import clock
from appliance.channel.admin import A, AdminRequest
from appliance.channel.answers.field_docs import Moment, VirtualAddress, doc
from appliance.channel.rest_bodies import WHOLE
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels.enrolment_kit import archive, members
from appliance.features.tunnels.host_routes import ANSWERS, OneName, add_host_routes
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.requests import SigningRequest
from appliance.features.tunnels.tunnel_answers import NewCertificate

TOKEN = r"^rosrv-enrol_[0-9a-f]{12}_[A-Za-z0-9_-]{43}$"  # noqa: S105  the form of one
PROOF = r"^[A-Za-z0-9+/]+={0,2}$"


class Enrolment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request of a host that enrols."""

    token: Annotated[str, doc("the one-time token", pattern=TOKEN + WHOLE)]
    request: SigningRequest


class Enrolled(msgspec.Struct, frozen=True, kw_only=True):
    """A host is enrolled; `files` are the files of its kit by path, without the private key."""

    name: Annotated[str, doc("name of the host")]
    address: VirtualAddress
    appliance: Annotated[str, doc("the appliance's address in the tunnel")]
    master: Annotated[str, doc("ROS_MASTER_URI through the tunnel")]
    serial: Annotated[str, doc("serial number of its certificate, in hexadecimal, or empty without one")]
    expires: Moment
    certificate: Annotated[str, doc("the certificate, in PEM")]
    authority: Annotated[str, doc("certificate of the hosts' authority, in PEM")]
    warning: Annotated[str | None, doc("a problem that needs a person's attention, or null if there is none")]
    files: Annotated[dict[str, str], doc("texts by their paths in the kit")]


class Renewal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A signing request for a new key, and the present key's signature over its bytes (base64)."""

    request: SigningRequest
    proof: Annotated[
        str,
        doc(
            "signature of the request with the current key, in base64",
            min_length=1,
            max_length=1024,
            pattern=PROOF + WHOLE,
        ),
    ]


_ALL = "all"
_ALL_PER_MINUTE = 60
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_KIT: Responses = {
    200: {
        "description": "Enrolled; with `Accept: application/gzip` the kit as an archive",
        "content": content(Enrolled) | _ARCHIVE,
    },
    403: {"description": "The token is wrong, was used, or has expired."},
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
    router = AnsweringRoutes(ANSWERS, tags=["hosts"])
    add_host_routes(router, services)
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
        peer = peer_of(request)
        patience.require(peer)
        try:
            parts = await _ask(services, host_requests.HostEnrol(brought.token, brought.request, peer))
        except ProblemError as problem:
            if problem.status == 403:
                patience.failed(peer)
            raise
        kit = kit_of(parts, KitOptions.of(parts.kept), None)
        if "application/gzip" in accept:
            return Response(archive(kit), media_type="application/gzip")
        files = {path: text for path, text, _mode in members(kit)}
        return answer(convert(asdict(parts) | {"files": files}, Enrolled))


def _add_renewal(router: Routes, services: Services) -> None:
    @router.post("/v1/hosts/{name}/renew", operation_id="renew_host", responses=_TUNNEL)
    async def renew(
        name: OneName, renewal: Annotated[Renewal, body(Renewal)], request: Request
    ) -> NewCertificate:
        """Return a certificate for a new key to a host in its tunnel; its present key has signed the request."""
        try:
            proof = base64.b64decode(renewal.proof, validate=True)
        except binascii.Error as error:
            raise ProblemError(422, "bad-input", f"body.proof: not base64: {error}") from None
        return await _ask(
            services, host_requests.HostRenewItself(name, renewal.request, proof, peer_of(request))
        )

    @router.post(
        "/v1/hosts/{name}/renewed",
        operation_id="host_renewed",
        responses=_TUNNEL,
        response_class=Response,
        status_code=204,
    )
    async def renewed(name: OneName, request: Request) -> None:
        """Note that a host in its tunnel has its new certificate. The previous certificate ends, and the tunnel is
        built again.
        """
        await _ask(services, host_requests.HostRenewed(name, peer_of(request)))

    @router.get("/v1/revocations", responses=_PEM, response_class=Response)
    async def revocations() -> Response:
        """Return the signed list of revoked certificates (CRL)."""
        listed = await _ask(services, host_requests.RevocationsWanted())
        return Response(listed.revocations, media_type="application/x-pem-file")

    @router.get("/v1/authority", responses=_PEM, response_class=Response)
    async def authority() -> Response:
        """Return the certificate of the appliance's authority."""
        own = await _ask(services, host_requests.AuthorityWanted())
        return Response(own.authority, media_type="application/x-pem-file")


class _Patience:
    def __init__(self, per_minute: int) -> None:
        self._one = Buckets(per_minute / 60, per_minute)
        # An attacker may have many addresses.
        self._all = Buckets(max(per_minute, _ALL_PER_MINUTE) / 60, max(per_minute, _ALL_PER_MINUTE), peers=1)

    def require(self, peer: str) -> None:
        now = clock.now()
        seconds = self._one.wait(peer, now)
        if self._one.touched(peer, now):
            seconds = max(seconds, self._all.wait(_ALL, now))
        if seconds:
            raise too_many("too-many-failures", "too many wrong enrolment tokens were sent", seconds)

    def failed(self, peer: str) -> None:
        now = clock.now()
        self._one.take(peer, now)
        self._all.take(_ALL, now)


async def _ask(services: Services, order: AdminRequest[A]) -> A:
    answer = await services.control.ask(order, None)
    if not answer.ok and answer.trouble == "forbidden":
        raise ProblemError(403, "not-recognised", answer.error)
    return answered(answer)
