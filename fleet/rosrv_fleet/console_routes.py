"""The console: one page with the robots and the search, rendered here. No script runs in it."""

from html import escape
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlencode

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from appliance.audit.filter_options import filter_given
from appliance.audit.query import FilterError
from appliance.audit.record_format import printable
from appliance.base.timestamps import TimestampError
from rosrv_fleet.access import COOKIE
from rosrv_fleet.collector import Collector
from rosrv_fleet.health import FleetHealth, RobotState, health_of
from rosrv_fleet.rollouts.console_section import rollouts_section
from rosrv_fleet.search import FleetPage, IndexDownError, SearchTooLongError, search_fleet
from rosrv_fleet.search_routes import MOST_WAITING
from rosrv_fleet.search_sql import FleetFilter

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'self'; form-action 'self'; frame-ancestors 'none';"
    " base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_WORDS = ("robot", "host", "caller", "topic", "event", "rule", "text", "who", "since", "until")
_ROWS = 100
_LONGEST_FORM = 4096


def console_router(collector: Collector) -> APIRouter:
    """Return the routes of the console."""
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def page(request: Request) -> Response:
        if collector.tokens.holder(request.cookies.get(COOKIE, "")) is None:
            return RedirectResponse("/login", 303, _HEADERS)
        asked = {name: request.query_params.get(name, "").strip() for name in (*_WORDS, "cursor", "decision")}
        found = _Found()
        if any(asked.values()):
            found = _search(collector, asked)
        rollouts = "" if collector.bundles is None else rollouts_section(collector.bundles)
        return _html("Robots", _robots(health_of(collector)) + rollouts + _form(asked) + found.shown(asked))

    @router.get("/login")
    def login() -> Response:
        return _html("Log in", _LOGIN)

    @router.post("/login")
    async def logged_in(request: Request) -> Response:
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > _LONGEST_FORM:
                raise HTTPException(413, "the form is too large")
        token = parse_qs(body.decode("ascii", "replace")).get("token", [""])[0].strip()
        if collector.tokens.holder(token) is None:
            return _html("Log in", '<p class="bad">This token is unknown.</p>' + _LOGIN, 401)
        answer = RedirectResponse("/", 303, _HEADERS)
        answer.set_cookie(
            COOKIE, token, secure=True, httponly=True, samesite="strict", path="/", max_age=12 * 3600
        )
        return answer

    @router.post("/logout")
    def logout() -> Response:
        answer = RedirectResponse("/login", 303, _HEADERS)
        answer.delete_cookie(COOKIE, path="/", secure=True, httponly=True, samesite="strict")
        return answer

    @router.get("/console.css")
    def style() -> Response:
        return Response(
            files("rosrv_fleet").joinpath("console.css").read_bytes(), media_type="text/css", headers=_HEADERS
        )

    return router


def _html(title: str, body: str, status: int = 200) -> HTMLResponse:
    return HTMLResponse(
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)} - ROSRV fleet</title>'
        '<meta name="viewport" content="width=device-width"><link rel="stylesheet" href="/console.css"></head>'
        f"<body>{body}</body></html>",
        status,
        _HEADERS,
    )


_LOGIN = (
    '<main class="login"><h1>ROSRV fleet</h1><form method="post" action="/login"><label>Token '
    '<input name="token" type="password" autocomplete="current-password" required autofocus></label>'
    "<button>Log in</button></form><p>Make one on the collector: <code>rosrv-fleet token add NAME</code></p></main>"
)


def _robots(health: FleetHealth) -> str:
    silent = sum(robot.silent for robot in health.robots)
    lead = f"{len(health.robots)} robots, {silent} silent, {health.waiting} segments not yet searchable"
    troubles = [text for text in (health.trouble, health.disk) if text is not None]
    rows = "".join(
        map(
            _robot,
            sorted(health.robots, key=lambda one: (not (one.gaps or one.forks), not one.silent, one.name)),
        )
    )
    return (
        '<header><h1>ROSRV fleet</h1><form method="post" action="/logout"><button>Log out</button></form></header>'
        f"<main><p>{lead}</p>"
        + "".join(f'<p class="bad">{escape(text)}</p>' for text in troubles)
        + '<table><caption>Robots</caption><thead><tr><th scope="col">Robot</th><th scope="col">State</th>'
        '<th scope="col" class="number">Newest segment</th><th scope="col">Arrived</th>'
        '<th scope="col" class="number">Gaps</th>'
        f'<th scope="col" class="number">Forks</th></tr></thead><tbody>{rows}</tbody></table>'
    )


def _robot(robot: RobotState) -> str:
    wrong = [
        word
        for word, wrong in (("silent", robot.silent), ("gap", robot.gaps), ("fork", robot.forks))
        if wrong
    ]
    good = "no segment yet" if robot.number is None else "complete"
    state = f'<td class="{"bad" if wrong else "good"}">{", ".join(wrong) or good}</td>'
    link = f'<a href="/?{escape(urlencode({"robot": robot.name}))}">{escape(robot.name)}</a>'
    arrived = "never" if robot.age_seconds is None else f"{_span(robot.age_seconds)} ago"
    number = "" if robot.number is None else str(robot.number)
    return (
        f'<tr><th scope="row">{link}</th>{state}<td class="number">{number}</td><td>{arrived}</td>'
        f'<td class="number">{robot.gaps}</td><td class="number">{robot.forks}</td></tr>'
    )


def _span(seconds: float) -> str:
    for unit, size in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _form(asked: dict[str, str]) -> str:
    fields = "".join(
        f'<label>{name} <input name="{name}" value="{escape(asked[name])}" maxlength="256"></label>'
        for name in _WORDS
    )
    choices = "".join(
        f'<option value="{value}"{" selected" if asked["decision"] == value else ""}>{text}</option>'
        for value, text in (
            ("", "any"),
            ("deny", "denied"),
            ("allow", "allowed"),
            ("would_deny", "would be denied"),
        )
    )
    return (
        f'<form class="search" action="/"><h2>Search</h2>{fields}'
        f'<label>decision <select name="decision">{choices}</select></label><button>Search</button></form>'
    )


class _Found:
    """The result of a search, or why it failed; empty if none was made."""

    def __init__(self, page: FleetPage | None = None, wrong: str = "") -> None:
        self._page = page
        self._wrong = wrong

    def shown(self, asked: dict[str, str]) -> str:
        """Return the HTML of the result."""
        if self._wrong:
            return f'<p class="bad">{escape(self._wrong)}</p></main>'
        if self._page is None:
            return "</main>"
        if not self._page.records:
            return "<p>No record matches.</p></main>"
        heads = "".join(
            f'<th scope="col">{name}</th>'
            for name in ("Time", "Robot", "Decision", "Event", "Host", "Caller", "Resource", "Reason")
        )
        rows = "".join(map(_record, self._page.records))
        more = ""
        if self._page.cursor is not None:
            given = {name: value for name, value in asked.items() if value} | {"cursor": self._page.cursor}
            more = f'<p><a href="/?{escape(urlencode(given))}">Older records</a></p>'
        head = f"<caption>Records</caption><thead><tr>{heads}</tr></thead>"
        return f"<table>{head}<tbody>{rows}</tbody></table>{more}</main>"


def _record(record: dict[str, Any]) -> str:
    decision = str(record.get("decision") or "")
    fields = (record["event"], record["host"], record["caller_id"], record["resource"], record["reason"])
    cells = "".join(f"<td>{escape(printable(str(value or '')))}</td>" for value in fields)
    kind = "bad" if decision == "deny" else ""
    return (
        f"<tr><td>{escape(record['time'][:23])}</td><td>{escape(record['robot'])}</td>"
        f'<td class="{kind}">{escape(printable(decision))}</td>{cells}</tr>'
    )


def _search(collector: Collector, asked: dict[str, str]) -> _Found:
    words: dict[str, Any] = {name: asked[name] or None for name in _WORDS if name != "robot"}
    if asked["decision"] in ("deny", "allow", "would_deny"):
        words[asked["decision"]] = True
    try:
        wanted = FleetFilter(asked["robot"] or None, filter_given(**words))
        waiting = len(collector.store.marked("pending", MOST_WAITING))
        return _Found(search_fleet(collector.database, wanted, asked["cursor"] or None, _ROWS, waiting))
    except (FilterError, TimestampError, SearchTooLongError, IndexDownError) as error:
        return _Found(wrong=str(error))
