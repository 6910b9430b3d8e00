"""`/v1/hosts`: who may come through a tunnel: list, enrol, give kits and one-time tokens, revoke.

Looking is for viewers, what `rosrv protect --check` saw is told by operators, all else is for admins. Every change
needs `If-Match` with the ETag of `GET /v1/hosts`, which is that of the table of hosts; tunnels going up and down do
not change it.
"""

import asyncio
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response

from appliance.api.access import Bearer
from appliance.api.hosts_models import (
    ENDPOINT,
    HOST_NAME,
    EnrolmentToken,
    Host,
    Hosts,
    KitWishes,
    NewHost,
    NewKit,
    PortsSeen,
    PortsTold,
    Reloaded,
    Revoked,
    TokenWishes,
)
from appliance.api.kits import Wishes, enrolment_of, kit_of
from appliance.api.preconditions import IfMatch, etag, expected_revision
from appliance.api.problems import ProblemError
from appliance.api.roles import Admin, Operator, Viewer, answered, ask
from appliance.api.services import Services
from appliance.channel.admin import (
    HostAdd,
    HostEndpoint,
    HostKit,
    HostList,
    HostPorts,
    HostRenew,
    HostRevoke,
    HostsReload,
    HostToken,
)
from appliance.ipsec.kit import archive
from appliance.ipsec.requests import make_key, signing_request

SLOW_SECONDS = 45.0  # charon may have to be started first
_Responses = dict[int | str, dict[str, Any]]
_TAG = {"ETag": {"description": "of the table of hosts", "schema": {"type": "string"}}}
_TAGGED: _Responses = {200: {"headers": _TAG}}
_UNKNOWN: _Responses = {404: {"description": "There is no such host."}}
_GUARDED: _Responses = {
    412: {"description": "The table of hosts is another than If-Match names."},
    428: {"description": "If-Match is missing."},
}
_CHANGES: _Responses = {**_TAGGED, **_GUARDED}
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_KIT: _Responses = {
    200: {"description": "The kit: an archive (.tar.gz)", "content": _ARCHIVE, "headers": _TAG}
}
_NEW: _Responses = {
    201: {
        "description": "Enrolled: the kit (how=kit); or a one-time token (how=token)",
        "model": EnrolmentToken,
        "content": _ARCHIVE,
        "headers": _TAG,
    }
}
OneName = Annotated[str, Path(min_length=1, max_length=63, pattern=HOST_NAME, description="of a host")]
OneHost = Annotated[str, Path(min_length=1, max_length=63, description="of a host, or a machine's address")]


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/hosts", tags=["hosts"])
    desk = _Desk(services)
    _add_looks(router, desk)
    _add_enrolment(router, desk)
    _add_changes(router, desk)
    return router


def _add_looks(router: APIRouter, desk: "_Desk") -> None:
    @router.get("", operation_id="hosts", responses=_TAGGED)
    async def hosts(bearer: Viewer, response: Response) -> Hosts:
        """Every host that is enrolled, declared or awaited, with its tunnel; and machines that nodes run on."""
        return Hosts.model_validate(await desk.tagged(HostList(), bearer, response))

    @router.get("/{name}", operation_id="host", responses=_TAGGED | _UNKNOWN)
    async def host(name: OneName, bearer: Viewer, response: Response) -> Host:
        """One host."""
        body = await desk.tagged(HostList(), bearer, response)
        for row in body["hosts"]:
            if row["name"] == name:
                return Host.model_validate(row)
        raise ProblemError(404, "unknown", f"there is no host {name}")

    @router.get("/{name}/kit", operation_id="host_kit", responses=_KIT | _UNKNOWN, response_class=Response)
    async def kit(
        name: OneName,
        bearer: Operator,
        endpoint: Annotated[
            str | None,
            Query(pattern=ENDPOINT, description="address or name at which the host reaches the appliance"),
        ] = None,
    ) -> Response:
        """The kit of an enrolled host as it is now, without its private key, which the host has."""
        body = await ask(desk.control, HostKit(name), bearer)
        placed = await desk.place(Wishes(endpoint or ""), bearer)
        return desk.archive(body, placed.wishes, None)


def _add_enrolment(router: APIRouter, desk: "_Desk") -> None:
    @router.post(
        "", operation_id="enrol_host", responses=_NEW | _GUARDED, response_class=Response, status_code=201
    )
    async def enrol_host(new: NewHost, bearer: Admin, if_match: IfMatch = None) -> Response:
        """Let a host in: by a one-time token that it brings with its own signing request, or by a kit."""
        expected = _expected(if_match)
        wishes = _wishes(new)
        if new.how == "token":
            if new.request is not None:
                raise ProblemError(
                    422, "bad-input", "a request goes with how=kit; a token is brought with one"
                )
            made, tag = await desk.token(new.name, new, wishes, expected, bearer)
            return Response(made.model_dump_json(), 201, {"ETag": tag}, media_type="application/json")
        key, request = await _key_and_request(new.request)
        order = HostAdd(new.name, request, new.days, new.address, expected)
        placed = await desk.place(wishes, bearer)
        body = await desk.slowly(order, bearer)
        return desk.archive(body, placed.wishes, key, 201)

    @router.post("/{name}/token", operation_id="host_token", responses=_CHANGES)
    async def token(
        name: OneName, wishes: TokenWishes, bearer: Admin, response: Response, if_match: IfMatch = None
    ) -> EnrolmentToken:
        """A one-time token: with it the host enrols itself, for the first time or anew with another key."""
        made, response.headers["ETag"] = await desk.token(
            name, wishes, _wishes(wishes), _expected(if_match), bearer
        )
        return made

    @router.post(
        "/{name}/kit",
        operation_id="new_host_kit",
        responses=_KIT | _UNKNOWN | _GUARDED,
        response_class=Response,
    )
    async def new_kit(name: OneName, new: NewKit, bearer: Admin, if_match: IfMatch = None) -> Response:
        """A new certificate for an enrolled host, in a kit; the one before is revoked, its tunnel closed."""
        expected, wishes = _expected(if_match), _wishes(new)
        key, request = await _key_and_request(new.request)
        placed = await desk.place(wishes, bearer)
        body = await desk.slowly(HostRenew(name, request, new.days, expected), bearer)
        return desk.archive(body, placed.wishes, key)


def _add_changes(router: APIRouter, desk: "_Desk") -> None:
    @router.post("/reload", operation_id="reload_hosts", responses=_CHANGES)
    async def reload(bearer: Operator, response: Response, if_match: IfMatch = None) -> Reloaded:
        """Read hosts.yaml again: tunnels that it wants or no longer wants; nobody is enrolled or revoked by it."""
        body = await desk.tagged(HostsReload(_expected(if_match)), bearer, response)
        return Reloaded.model_validate(body)

    @router.delete("/{name}", operation_id="revoke_host", responses=_CHANGES | _UNKNOWN)
    async def revoke(name: OneName, bearer: Admin, response: Response, if_match: IfMatch = None) -> Revoked:
        """Let a host in no more: its certificate, tunnel, registrations and connections end within a second."""
        body = await desk.tagged(HostRevoke(name, _expected(if_match)), bearer, response)
        return Revoked.model_validate({field: body[field] for field in Revoked.model_fields})

    @router.put("/{name}/ports", operation_id="tell_host_ports", responses=_CHANGES | _UNKNOWN)
    async def ports(
        name: OneHost, told: PortsTold, bearer: Operator, response: Response, if_match: IfMatch = None
    ) -> PortsSeen:
        """Tell whether the ROS ports of a host are closed, as `rosrv protect --check` saw it from outside."""
        order = HostPorts(name, told.state, told.open, told.checked, _expected(if_match))
        body = await desk.tagged(order, bearer, response)
        return PortsSeen.model_validate(body["ports"])


@dataclass(frozen=True)
class _Placed:
    """`reason`: why the endpoint is that, where none was given."""

    wishes: Wishes
    reason: str = ""


class _Desk:
    """What the routes share."""

    def __init__(self, services: Services) -> None:
        self.control = services.control

    async def tagged(self, order: Any, bearer: Bearer, response: Response) -> dict[str, Any]:
        """Control's answer; its revision is the ETag."""
        body = await ask(self.control, order, bearer)
        response.headers["ETag"] = etag(body["revision"])
        return body

    async def slowly(self, order: Any, bearer: Bearer) -> dict[str, Any]:
        """Control's answer to what waits for charon or the signer."""
        return answered(await self.control.ask(order, bearer, SLOW_SECONDS))

    async def place(self, wishes: Wishes, bearer: Bearer) -> "_Placed":
        """The wishes with the address of the appliance, which it finds where nobody said it."""
        if wishes.endpoint:
            return _Placed(wishes)
        body = await ask(self.control, HostEndpoint(), bearer)
        return _Placed(replace(wishes, endpoint=body["endpoint"]), body["reason"])

    async def token(
        self, name: str, asked: "NewHost | TokenWishes", wishes: Wishes, expected: int | None, bearer: Bearer
    ) -> tuple[EnrolmentToken, str]:
        """A one-time token with its script, and the ETag."""
        placed = await self.place(wishes, bearer)
        kept, seconds = placed.wishes.kept(), asked.token_seconds
        order = HostToken(
            name, kept, seconds, asked.days, asked.address, expected, new=isinstance(asked, NewHost)
        )
        body = await self.slowly(order, bearer)
        try:
            enrolment = enrolment_of(body, placed.wishes)
        except ValueError as error:
            raise ProblemError(503, "not-available", str(error)) from None
        made = EnrolmentToken(
            name=name,
            address=body["address"],
            token=body["token"],
            expires=body["token_expires"],
            endpoint=placed.wishes.endpoint,
            endpoint_reason=placed.reason,
            url=enrolment.url,
            pin=enrolment.pin,
            authority=enrolment.authority,
            script=enrolment.script(),
        )
        return made, etag(body["revision"])

    def archive(self, body: dict[str, Any], wishes: Wishes, key: str | None, status: int = 200) -> Response:
        """A kit as it is downloaded."""
        headers = {
            "ETag": etag(body["revision"]),
            "Content-Disposition": f'attachment; filename="rosrv-{body["name"]}.tar.gz"',
        }
        return Response(archive(kit_of(body, wishes, key)), status, headers, "application/gzip")


def _expected(if_match: str | None) -> int | None:
    return expected_revision(if_match, "table of hosts", "/v1/hosts")


def _wishes(given: KitWishes) -> Wishes:
    try:
        return Wishes(given.endpoint or "", given.ports, tuple(given.open))
    except ValueError as error:
        raise ProblemError(422, "bad-input", str(error)) from None


async def _key_and_request(request: str | None) -> tuple[str | None, str]:
    """A key made here and its request, unless the host has made its own."""
    if request is not None:
        return None, request
    key = await asyncio.to_thread(make_key)
    return key.decode(), signing_request(key, "host").decode()
