"""`/v1/hosts`: who may come through a tunnel: list, enrol, give kits and one-time tokens, revoke.

Looking is for viewers, what `rosrv protect --check` saw is told by operators, all else is for admins. Every change
needs `If-Match` with the ETag of `GET /v1/hosts`, which is that of the table of hosts; tunnels going up and down do
not change it.
"""

import asyncio
from dataclasses import replace
from typing import Annotated

from fastapi import Path, Query, Response

from appliance.api.access import Bearer
from appliance.api.hosts_models import ENDPOINT, HOST_NAME, KitWishes, NewHost, NewKit, PortsTold, TokenWishes
from appliance.api.kits import Wishes, kit_of
from appliance.api.moments import given
from appliance.api.preconditions import IfMatch, etag, expected_revision
from appliance.api.problems import ProblemError
from appliance.api.route_roles import Admin, Operator, Viewer, answered, ask
from appliance.api.routing import ETAG, Responses, Routes, Tagged, answer, body, content, tagged
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.answers import host_answers as answers
from appliance.ipsec.enrolment_kit import archive
from appliance.ipsec.requests import make_key, signing_request

SLOW_SECONDS = 45.0  # charon may have to be started first
_UNKNOWN: Responses = {404: {"description": "There is no such host."}}
_CHANGES: Responses = {
    412: {"description": "The table of hosts is another than If-Match names."},
    428: {"description": "If-Match is missing."},
}
_ARCHIVE = {"application/gzip": {"schema": {"type": "string", "format": "binary"}}}
_KIT: Responses = {
    200: {"description": "The kit: an archive (.tar.gz)", "content": _ARCHIVE, "headers": ETAG}
}
_NEW: Responses = {
    201: {
        "description": "Enrolled: the kit (how=kit); or a one-time token (how=token)",
        "content": content(answers.EnrolmentToken) | _ARCHIVE,
        "headers": ETAG,
    }
}
OneName = Annotated[
    str, Path(min_length=1, max_length=63, pattern=HOST_NAME, description="of a host", examples=["ocu-1"])
]
OneHost = Annotated[
    str,
    Path(min_length=1, max_length=63, description="of a host, or a machine's address", examples=["ocu-1"]),
]


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/hosts", tags=["hosts"])
    _add_looks(router, services)
    _add_enrolment(router, services)
    _add_changes(router, services)
    return router


def _add_looks(router: Routes, services: Services) -> None:
    control = services.control

    @router.get("")
    async def hosts(bearer: Viewer) -> Tagged[answers.Hosts]:
        """Every host that is enrolled, declared or awaited, with its tunnel; and machines that nodes run on."""
        return tagged(await ask(control, admin.HostList(), bearer))

    @router.get("/{name}", responses=_UNKNOWN)
    async def host(name: OneName, bearer: Viewer) -> Tagged[answers.Host]:
        """One host."""
        found = await ask(control, admin.HostList(), bearer)
        for host in found.hosts:
            if host.name == name:
                return Tagged(host, found.revision)
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
        parts = await ask(control, admin.HostKit(name), bearer)
        return _archive(parts, await _placed(services, Wishes(endpoint or ""), bearer), None)


def _add_enrolment(router: Routes, services: Services) -> None:
    @router.post("", responses=_NEW | _CHANGES, response_class=Response, status_code=201)
    async def enrol_host(
        new: Annotated[NewHost, body(NewHost)], bearer: Admin, if_match: IfMatch = None
    ) -> Response:
        """Let a host in: by a one-time token that it brings with its own signing request, or by a kit."""
        expected, wishes = _expected(if_match), _wishes(new)
        if new.how == "token":
            if new.request is not None:
                raise ProblemError(
                    422, "bad-input", "a request goes with how=kit; a token is brought with one"
                )
            made = await _token(services, new.name, new, expected, bearer)
            return answer(made, 201, made.revision)
        key, request = await _key_and_request(new.request)
        order = admin.HostAdd(new.name, request, new.days, new.address, expected)
        wishes = await _placed(services, wishes, bearer)
        parts = answered(await services.control.ask(order, bearer, SLOW_SECONDS))
        return _archive(parts, wishes, key, 201)

    @router.post("/{name}/token", operation_id="host_token", responses=_CHANGES)
    async def token(
        name: OneName,
        wishes: Annotated[TokenWishes, body(TokenWishes)],
        bearer: Admin,
        if_match: IfMatch = None,
    ) -> Tagged[answers.EnrolmentToken]:
        """A one-time token: with it the host enrols itself, for the first time or anew with another key."""
        return tagged(await _token(services, name, wishes, _expected(if_match), bearer))

    @router.post(
        "/{name}/kit",
        operation_id="new_host_kit",
        responses=_KIT | _UNKNOWN | _CHANGES,
        response_class=Response,
    )
    async def new_kit(
        name: OneName, new: Annotated[NewKit, body(NewKit)], bearer: Admin, if_match: IfMatch = None
    ) -> Response:
        """A new certificate for an enrolled host, in a kit; the one before is revoked, its tunnel closed."""
        expected, wishes = _expected(if_match), _wishes(new)
        key, request = await _key_and_request(new.request)
        wishes = await _placed(services, wishes, bearer)
        order = admin.HostRenew(name, request, new.days, expected)
        return _archive(answered(await services.control.ask(order, bearer, SLOW_SECONDS)), wishes, key)


def _add_changes(router: Routes, services: Services) -> None:
    control = services.control

    @router.post("/reload", operation_id="reload_hosts", responses=_CHANGES)
    async def reload(bearer: Operator, if_match: IfMatch = None) -> Tagged[answers.Reloaded]:
        """Read hosts.yaml again: tunnels that it wants or no longer wants; nobody is enrolled or revoked by it."""
        return tagged(await ask(control, admin.HostsReload(_expected(if_match)), bearer))

    @router.delete("/{name}", operation_id="revoke_host", responses=_CHANGES | _UNKNOWN)
    async def revoke(name: OneName, bearer: Admin, if_match: IfMatch = None) -> Tagged[answers.Revoked]:
        """Let a host in no more: its certificate, tunnel, registrations and connections end within a second."""
        return tagged(await ask(control, admin.HostRevoke(name, _expected(if_match)), bearer))

    @router.put("/{name}/ports", operation_id="tell_host_ports", responses=_CHANGES | _UNKNOWN)
    async def ports(
        name: OneHost, told: Annotated[PortsTold, body(PortsTold)], bearer: Operator, if_match: IfMatch = None
    ) -> Tagged[answers.PortsSeen]:
        """Tell whether the ROS ports of a host are closed, as `rosrv protect --check` saw it from outside."""
        checked = given(told.checked) / 1e9 if isinstance(told.checked, str) else told.checked
        order = admin.HostPorts(name, told.state, told.open, checked, _expected(if_match))
        known = await ask(control, order, bearer)
        return Tagged(known.ports, known.revision)


async def _placed(services: Services, wishes: Wishes, bearer: Bearer) -> Wishes:
    """The wishes with the address of the appliance, which it finds where nobody said it."""
    if wishes.endpoint:
        return wishes
    found = await ask(services.control, admin.HostEndpoint(), bearer)
    return replace(wishes, endpoint=found.endpoint)


async def _token(
    services: Services, name: str, asked: TokenWishes, expected: int | None, bearer: Bearer
) -> answers.EnrolmentToken:
    _wishes(asked)  # refuses what makes no sense
    said = {field: getattr(asked, field) for field in TokenWishes.__struct_fields__}
    order = admin.HostToken(name, **said, expected=expected, new=isinstance(asked, NewHost))
    return answered(await services.control.ask(order, bearer, SLOW_SECONDS))


def _archive(parts: answers.KitParts, wishes: Wishes, key: str | None, status: int = 200) -> Response:
    """A kit as it is downloaded."""
    headers = {
        "ETag": etag(parts.revision),
        "Content-Disposition": f'attachment; filename="rosrv-{parts.name}.tar.gz"',
    }
    return Response(archive(kit_of(parts, wishes, key)), status, headers, "application/gzip")


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
