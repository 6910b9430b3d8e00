"""Routes of `/v1/hosts` that are not derived: one host, its kit, and changes whose answer is not control's.

Every change needs `If-Match` with the ETag of `GET /v1/hosts`, which does not change when a tunnel goes up or
down.
"""

import asyncio
from dataclasses import replace
from typing import Annotated, Any

from fastapi import Path, Query, Response
from msgspec import structs

from appliance.api.front.etags import etag
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Operator, Viewer, ask
from appliance.api.front.routing import ETAG, Responses, Routes, Tagged, answer, content, tagged
from appliance.api.front.services import Services
from appliance.api.routes.operation_routes import Answer, OperationCall
from appliance.channel.answers.host_answers import Host, PortsSeen
from appliance.features.tunnels import requests as host_requests
from appliance.features.tunnels import tunnel_answers as answers
from appliance.features.tunnels.enrolment_kit import archive
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.requests import ENDPOINT, HOST_NAME, KitWishes
from appliance.ipsec.requests import make_key, signing_request

_UNKNOWN: Responses = {404: {"description": "There is no such host."}}
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_KIT: Responses = {
    200: {"description": "The kit: an archive (.tar.gz)", "content": _ARCHIVE, "headers": ETAG}
}
OneName = Annotated[
    str,
    Path(min_length=1, max_length=63, pattern=HOST_NAME, description="name of the host", examples=["ocu-1"]),
]


def add_host_routes(router: Routes, services: Services) -> None:
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
        "/v1/hosts/{name}/kit", operation_id="host_kit", responses=_KIT | _UNKNOWN, response_class=Response
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
    return tagged(await call.ask(call.order))


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
