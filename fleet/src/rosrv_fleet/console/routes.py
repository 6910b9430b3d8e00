"""The routes of the console: log in, show the pages, and stop or revert a rollout after a confirmation.

A change requires the role operator and the cookie, which browsers send only from this site. An `Origin` of another
site is rejected.
"""

from collections.abc import Callable
from html import escape
from importlib.resources import files
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import APIRouter, HTTPException, Request
from fastapi import Path as PathParameter
from fastapi.responses import RedirectResponse, Response
from psycopg import Error as DatabaseError

from rosrv_fleet.access import COOKIE
from rosrv_fleet.collector import Collector
from rosrv_fleet.console.evidence_page import FILTERS as EVIDENCE_FILTERS
from rosrv_fleet.console.evidence_page import evidence_page
from rosrv_fleet.console.frame import HEADERS, alert, page
from rosrv_fleet.console.robots_page import FILTERS, robots_page
from rosrv_fleet.console.rollout_pages import Act, confirm_page, group_page, groups_page
from rosrv_fleet.console.search_page import ASKED, search_page
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.request_body import read_body
from rosrv_fleet.rollouts.service import BundleService, RolloutRefusedError
from rosrv_fleet.tokens import FleetRole, OperatorToken, OperatorTokens

_LONGEST_FORM = 4096
_NO_BUNDLES = "This collector has no bundles: its configuration has no section `bundles` (docs/fleet.md)."
_LOGIN = (
    '<div class="login"><h1>ROSRV fleet</h1>{wrong}<form method="post" action="/login"><label>Token '
    '<input name="token" type="password" autocomplete="current-password" required autofocus></label>'
    "<button>Log in</button></form><p>Make one on the collector: <code>rosrv-fleet token add NAME</code></p></div>"
)
Word = Annotated[str, PathParameter(max_length=63)]


def console_router(collector: Collector) -> APIRouter:
    router = APIRouter(include_in_schema=False)

    def shown(request: Request, title: str, body: Callable[[OperatorToken], str]) -> Response:
        holder = collector.tokens.holder(request.cookies.get(COOKIE, ""))
        if holder is None:
            return RedirectResponse("/login", 303, HEADERS)
        try:
            return page(title, body(holder), holder)
        except RolloutRefusedError as error:
            return page(title, f"<h1>Not found</h1>{alert(str(error))}", holder, 404)
        except OSError as error:
            return page(title, f"<h1>{escape(title)}</h1>{alert(str(error))}", holder, 503)

    def bundles() -> BundleService:
        if collector.bundles is None:
            raise RolloutRefusedError(_NO_BUNDLES)
        return collector.bundles

    def known(site: str, group: str) -> RobotGroup:
        place = bundles().group(site, group)
        if place not in bundles().robots and place not in bundles().rollouts:
            raise RolloutRefusedError(
                f"no robot is enrolled in {place}: rosrv-fleet robot group NAME {place}"
            )
        return place

    @router.get("/")
    def robots(request: Request) -> Response:
        return shown(request, "Robots", lambda _holder: robots_page(collector, _asked(request, FILTERS)))

    @router.get("/search")
    def search(request: Request) -> Response:
        return shown(
            request, "Search", lambda viewer: search_page(collector, viewer.name, _asked(request, ASKED))
        )

    @router.get("/evidence")
    def evidence(request: Request) -> Response:
        def body(holder: OperatorToken) -> str:
            asked = _asked(request, EVIDENCE_FILTERS)
            return evidence_page(collector, asked, may_get=holder.may(FleetRole.OPERATOR))

        return shown(request, "Evidence", body)

    @router.get("/rollouts")
    def groups(request: Request) -> Response:
        return shown(request, "Rollouts", lambda _holder: groups_page(bundles()))

    @router.get("/rollouts/{site}/{group}")
    def one_group(request: Request, site: Word, group: Word) -> Response:
        def body(holder: OperatorToken) -> str:
            return group_page(bundles(), known(site, group), may_change=holder.may(FleetRole.OPERATOR))

        return shown(request, f"Rollouts of {site}/{group}", body)

    @router.get("/rollouts/{site}/{group}/{act}")
    def confirm(request: Request, site: Word, group: Word, act: Act) -> Response:
        holder = collector.tokens.holder(request.cookies.get(COOKIE, ""))
        if holder is not None and not holder.may(FleetRole.OPERATOR):
            return _forbidden(holder)

        def body(_holder: OperatorToken) -> str:
            stored = bundles().rollouts.get(known(site, group))
            if stored is None:
                raise RolloutRefusedError(f"there was no rollout of {site}/{group}")
            return confirm_page(known(site, group), act, stored)

        return shown(request, f"Rollouts of {site}/{group}: {act}", body)

    @router.post("/rollouts/{site}/{group}/{act}")
    async def carry_out(request: Request, site: Word, group: Word, act: Act) -> Response:
        _require_own_origin(request)
        given = await _form(request)
        holder = collector.tokens.holder(request.cookies.get(COOKIE, ""))
        if holder is None:
            return RedirectResponse("/login", 303, HEADERS)
        if not holder.may(FleetRole.OPERATOR):
            return _forbidden(holder)
        title, number = f"Rollouts of {site}/{group}", given.get("number", "")
        try:
            change = bundles().stop if act == "stop" else bundles().revert
            await change(known(site, group), holder.name, int(number) if number.isdecimal() else -1)
        except RolloutRefusedError as error:
            return page(title, f"<h1>Not done</h1>{alert(str(error))}", holder, 409)
        except (DatabaseError, OSError) as error:
            return page(title, f"<h1>Not done</h1>{alert(f'{error}: try again later')}", holder, 503)
        return RedirectResponse(f"/rollouts/{site}/{group}", 303, HEADERS)

    router.include_router(_session_router(collector.tokens))
    return router


def _session_router(tokens: OperatorTokens) -> APIRouter:
    router = APIRouter()

    @router.get("/login")
    def login() -> Response:
        return page("Log in", _LOGIN.format(wrong=""), None)

    @router.post("/login")
    async def logged_in(request: Request) -> Response:
        _require_own_origin(request)
        token = (await _form(request)).get("token", "").strip()
        if tokens.holder(token) is None:
            return page("Log in", _LOGIN.format(wrong=alert("This token is unknown.")), None, 401)
        answer = RedirectResponse("/", 303, HEADERS)
        answer.set_cookie(
            COOKIE, token, secure=True, httponly=True, samesite="strict", path="/", max_age=12 * 3600
        )
        return answer

    @router.post("/logout")
    def logout(request: Request) -> Response:
        _require_own_origin(request)
        answer = RedirectResponse("/login", 303, HEADERS)
        answer.delete_cookie(COOKIE, path="/", secure=True, httponly=True, samesite="strict")
        return answer

    @router.get("/console.css")
    def style() -> Response:
        css = files("rosrv_fleet.console").joinpath("console.css").read_bytes()
        return Response(css, media_type="text/css", headers=HEADERS)

    return router


def _asked(request: Request, names: tuple[str, ...]) -> dict[str, str]:
    return {name: request.query_params.get(name, "").strip()[:1024] for name in names}


def _forbidden(holder: OperatorToken) -> Response:
    why = f"The token {holder.name} has the role {holder.role}; this needs {FleetRole.OPERATOR}."
    return page("Forbidden", f"<h1>Forbidden</h1>{alert(why)}", holder, 403)


def _require_own_origin(request: Request) -> None:
    """Raise `HTTPException` (403) for a form of another site. Clients other than browsers may omit `Origin`."""
    own = f"https://{request.headers.get('host', '')}"
    if request.headers.get("origin", own) != own:
        raise HTTPException(403, "this form was sent by another site")


async def _form(request: Request) -> dict[str, str]:
    body = await read_body(request, _LONGEST_FORM)
    return {name: values[0] for name, values in parse_qs(body.decode("ascii", "replace")).items()}
