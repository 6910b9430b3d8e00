"""Answer a host's own requests, without a bearer token: enrolment, renewal, authority, revocations; and `/v1/hosts`.

1. A host that sends wrong tokens must wait, and all such hosts share one limit. A host that sent no wrong token never
   waits, so an attacker with many addresses cannot keep out a valid token.
2. Only a host in its tunnel can renew (`enrolment.py`).
3. Signing requests are not parsed here: only the signer does so.
"""

import asyncio
import base64
import binascii
from dataclasses import replace
from typing import Annotated, Any

import msgspec
from fastapi import Header, Path, Query, Request, Response
from msgspec import convert, structs

from appliance.api.front.etags import etag
from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets
from appliance.api.front.route_roles import Operator, Viewer, ask, unwrap
from appliance.api.front.routing import ETAG, Responses, Routes, Tagged, answer, body, content, file, with_tag
from appliance.api.front.services import Services
from appliance.api.front.streams import peer_of
from appliance.api.routes.operation_routes import Answer, AnsweringRoutes, OperationCall
from appliance.base import clock
from appliance.channel.admin import A, AdminRequest
from appliance.channel.answers.field_docs import Moment, VirtualAddress, doc
from appliance.channel.answers.host_answers import Host, PortsSeen
from appliance.channel.rest_bodies import WHOLE
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels import tunnel_answers as answers
from appliance.features.tunnels.enrolment_kit import archive, members
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.requests import ENDPOINT, HOST_NAME, KitWishes, SigningRequest
from appliance.ipsec.requests import make_key, signing_request

# Routes of `/v1/hosts` that are not derived: one host, its kit, and changes whose answer is not control's.
#
# Every change needs `If-Match` with the ETag of `GET /v1/hosts`, which does not change when a tunnel goes up or
# down.

_UNKNOWN: Responses = {404: {"description": "There is no such host."}}
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_PRESENT_KIT: Responses = {
    200: {"description": "The kit: an archive (.tar.gz)", "content": _ARCHIVE, "headers": ETAG},
    404: {"description": "There is no such host."},
}
OneName = Annotated[
    str,
    Path(min_length=1, max_length=63, pattern=HOST_NAME, description="name of the host", examples=["ocu-1"]),
]


def _add_hosts(router: Routes, services: Services) -> None:
    control = services.control

    @router.get("/v1/hosts/{name}", responses=_UNKNOWN)
    async def host(name: OneName, bearer: Viewer) -> Tagged[Host]:
        """One host."""
        found = await ask(control, host_requests.HostList(), bearer)
        for host in found.hosts:
            if host.name == name:
                return Tagged(host, found.revision)
        raise ProblemError(404, "unknown", f"there is no host {name}: GET /v1/hosts lists them")

    @router.get(
        "/v1/hosts/{name}/kit",
        operation_id="host_kit",
        responses=_PRESENT_KIT,
        response_class=Response,
    )
    async def kit(
        name: OneName,
        bearer: Operator,
        endpoint: Annotated[
            str | None,
            Query(pattern=ENDPOINT, description="address or name at which the host reaches the appliance"),
        ] = None,
    ) -> Response:
        """Return the present kit of an enrolled host, without its private key, which the host has."""
        parts = await ask(control, host_requests.HostKit(name), bearer)
        wishes = KitOptions(endpoint or (await ask(control, host_requests.HostEndpoint(), bearer)).endpoint)
        return _archive(parts, wishes, None)


async def _token(call: OperationCall[host_requests.HostToken]) -> Tagged[answers.EnrolmentToken]:
    _wishes(call.body)  # rejects invalid options
    return with_tag(await call.ask(call.order))


async def _enrol(call: OperationCall[Any]) -> Response:
    if call.body.how == "kit":
        return await _kit(call)
    if call.body.request is not None:
        raise ProblemError(
            422, "bad-input", "`request` needs how=kit; with a token, the host sends its own request"
        )
    made = (await _token(call)).body
    return answer(made, 201, made.revision)


async def _kit(call: OperationCall[Any]) -> Response:
    wishes, key, order = _wishes(call.body), None, call.order
    if not order.request:
        made = await asyncio.to_thread(make_key)
        key, order = made.decode(), structs.replace(order, request=signing_request(made, "host").decode())
    if not wishes.endpoint:
        wishes = replace(wishes, endpoint=(await call.ask(host_requests.HostEndpoint())).endpoint)
    return _archive(await call.ask(order), wishes, key, call.operation.status)


async def _ports(call: OperationCall[host_requests.HostPorts]) -> Tagged[PortsSeen]:
    known = await call.ask(call.order)
    return Tagged(known.ports, known.revision)


def _archive(parts: answers.KitParts, wishes: KitOptions, key: str | None, status: int = 200) -> Response:
    headers = {
        "ETag": etag(parts.revision),
        "Content-Disposition": f'attachment; filename="rosrv-{parts.name}.tar.gz"',
    }
    return Response(archive(kit_of(parts, wishes, key)), status, headers, "application/gzip")


def _wishes(given: KitWishes) -> KitOptions:
    try:
        return KitOptions(given.endpoint or "", given.ports, tuple(given.open))
    except ValueError as error:
        raise ProblemError(422, "bad-input", str(error)) from None


ANSWERS = {
    "enrol_host": Answer(_enrol, {"content": content(answers.EnrolmentToken) | _ARCHIVE, "headers": ETAG}),
    "host_token": Answer(_token),
    "new_host_kit": Answer(_kit, {"content": _ARCHIVE, "headers": ETAG}),
    "tell_host_ports": Answer(_ports),
}


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
    _add_hosts(router, services)
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
        return answer(convert(structs.asdict(parts) | {"files": files}, Enrolled))


def _add_renewal(router: Routes, services: Services) -> None:
    @router.post("/v1/hosts/{name}/renew", operation_id="renew_host", responses=_TUNNEL)
    async def renew(
        name: OneName, renewal: Annotated[Renewal, body(Renewal)], request: Request
    ) -> answers.NewCertificate:
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
        if self._one.is_touched(peer, now):
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
    return unwrap(answer)
