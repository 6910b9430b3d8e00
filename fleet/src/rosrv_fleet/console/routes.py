"""The routes of the console: log in, show the pages, and stop or revert a rollout after a confirmation.

A change requires the role operator and the cookie, which browsers send only from this site. An `Origin` of another
site is rejected.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Annotated, Any, NamedTuple
from urllib.parse import parse_qs

from fastapi import APIRouter, HTTPException, Request
from fastapi import Path as PathParameter
from fastapi.responses import RedirectResponse, Response
from psycopg import Error as DatabaseError

from appliance.audit.search.filter_options import filter_given
from appliance.audit.search.query import FilterError
from appliance.base.counted import counted
from appliance.base.timestamps import TimestampError, parse_timestamp
from rosrv_fleet.access import COOKIE
from rosrv_fleet.collector import Collector
from rosrv_fleet.console.frame import (
    HEADERS,
    Column,
    Tone,
    ago,
    alert,
    badge,
    choice,
    field,
    link,
    local_time,
    moment,
    page,
    row,
    table,
    text,
)
from rosrv_fleet.console.rollout_pages import Act, confirm_page, group_page, groups_page
from rosrv_fleet.database import INCOMPLETE
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.evidence.store import StoredEvidence
from rosrv_fleet.health import FleetHealth, RobotState, health_of
from rosrv_fleet.request_body import read_body
from rosrv_fleet.rollouts.service import BundleService, ConditionKind, RobotCondition, RolloutRefusedError
from rosrv_fleet.search import (
    FleetPage,
    IndexDownError,
    SearchTooLongError,
    TooManySearchesError,
    search_fleet,
)
from rosrv_fleet.search_sql import FleetFilter
from rosrv_fleet.tokens import FleetRole, OperatorToken, OperatorTokens

# The page that searches the records of all robots.

WORDS = ("robot", "host", "caller", "topic", "event", "rule", "text", "who", "since", "until")
ASKED = (*WORDS, "decision", "cursor")
_DECISIONS = (
    ("", "any"),
    ("deny", "denied"),
    ("allow", "allowed"),
    ("would_deny", "would be denied"),
    ("ask", "waited for approval"),
)
_ROWS = 100
_SEARCH_COLUMNS = tuple(
    map(
        Column,
        ("Time", "Robot", "Decision", "Event", "Host", "Caller", "Resource", "Reason", "Evidence"),
    )
)


def search_page(collector: Collector, viewer: str, asked: Mapping[str, str]) -> str:
    result = _result(collector, viewer, asked) if any(asked.values()) else ""
    return "<h1>Search</h1>" + _search_form(asked) + result


def _search_form(asked: Mapping[str, str]) -> str:
    fields = "".join(field(name, asked[name]) for name in WORDS)
    return (
        f'<form class="filter" action="/search" role="search" aria-label="Records">{fields}'
        + choice("decision", "decision", _DECISIONS, asked["decision"])
        + "<button>Search</button></form>"
    )


def _result(collector: Collector, viewer: str, asked: Mapping[str, str]) -> str:
    words: dict[str, Any] = {name: asked[name] or None for name in WORDS if name != "robot"}
    if asked["decision"] in dict(_DECISIONS) and asked["decision"]:
        words[asked["decision"]] = True
    try:
        wanted = FleetFilter(asked["robot"] or None, filter_given(**words))
        with collector.searches.turn(viewer) as database:
            waiting = collector.store.waiting()
            found = search_fleet(database, wanted, asked["cursor"] or None, _ROWS, waiting)
    except (FilterError, TimestampError, SearchTooLongError, IndexDownError, TooManySearchesError) as error:
        return alert(str(error))
    return _shown(found, asked, collector.evidence.all())


def _shown(found: FleetPage, asked: Mapping[str, str], bundles: Sequence[StoredEvidence]) -> str:
    more = ""
    if found.cursor is not None:
        more = f'<p class="pages">{link("/search", "Older records", **{**asked, "cursor": found.cursor})}</p>'
    missing = ""
    if found.waiting:
        missing = alert(f"{found.waiting:,} stored segments are not indexed yet: this search misses them.")
    if not found.complete:
        missing += alert(INCOMPLETE)
    rows = (_record(record, bundles) for record in found.records)
    return missing + table("Records", _SEARCH_COLUMNS, rows, "No record matches.") + more


def _record(record: dict[str, Any], bundles: Sequence[StoredEvidence]) -> str:
    decision = str(record.get("decision") or "")
    covering = next((bundle.id for bundle in bundles if bundle.has(record)), None)
    words = (record["event"], record["host"], record["caller_id"], record["resource"], record["reason"])
    return row(
        _SEARCH_COLUMNS,
        (
            text(local_time(parse_timestamp(record["time"], 0), 3)),
            text(record["robot"]),
            badge("bad" if decision == "deny" else "plain", decision) if decision else "",
            *(text(word or "") for word in words),
            "" if covering is None else link("/evidence", covering[:12], id=covering),
        ),
    )


# The page of the robots, problems first, with a filter and a hundred rows a page.

ROWS = 100
FLEET_FILTERS = ("name", "group", "state", "page")
_ROBOT_COLUMNS = (
    Column("Robot"),
    Column("Group"),
    Column("Log"),
    Column("Segment", number=True),
    Column("Arrived", number=True),
    Column("Heard", number=True),
    Column("Gaps", number=True),
    Column("Forks", number=True),
    Column("Bundle"),
    Column("In force"),
    Column("Reason"),
)
_TONES: dict[str, Tone] = {
    "fork": "bad",
    "gap": "bad",
    "silent": "bad",
    "unhealthy": "bad",
    "certificate ends": "warn",
    "never seen": "warn",
    "behind": "warn",
    "no segment yet": "warn",
    "off": "plain",
    "complete": "good",
    "in force": "good",
}
_RENEWAL_SECONDS = 30 * 86_400.0
_PROBLEMS = ("fork", "gap", "unhealthy", "silent", "certificate ends", "never seen", "behind")
"""The words for problems, the worst first."""
_SHOWN = (*_PROBLEMS, "off", "in force")


class RobotRow(NamedTuple):
    """A robot with the state of its log, its group and its bundle. `condition` is None if it can have no bundles."""

    state: RobotState
    group: str
    condition: RobotCondition | None
    in_force: str

    @property
    def log(self) -> list[str]:
        found = (
            ("fork", self.state.forks),
            ("gap", self.state.gaps),
            ("silent", self.state.silent),
            ("certificate ends", self.state.certificate_seconds < _RENEWAL_SECONDS),
            ("off", self.state.off),
        )
        wrong = [word for word, wrong in found if wrong]
        return wrong or ["no segment yet" if self.state.number is None else "complete"]

    @property
    def words(self) -> set[str]:
        return {*self.log, *(() if self.condition is None else (self.condition.kind.value,))}

    @property
    def rank(self) -> tuple[int, str]:
        worst = min(
            (_PROBLEMS.index(word) for word in self.words if word in _PROBLEMS), default=len(_PROBLEMS)
        )
        return worst, self.state.name


def robot_rows(collector: Collector, health: FleetHealth) -> list[RobotRow]:
    enrolled = collector.robots.known()
    bundles = {} if collector.bundles is None else _bundles(collector.bundles)
    return sorted(
        (
            RobotRow(state, enrolled[state.name].group, *bundles.get(state.name, (None, "")))
            for state in health.robots
        ),
        key=lambda one: one.rank,
    )


def _bundles(service: BundleService) -> dict[str, tuple[RobotCondition, str]]:
    return {
        name: (condition, robots[name].in_force)
        for group, robots in service.robots.items()
        for name, condition in service.conditions(group).items()
        if name in robots
    }


def robots_page(collector: Collector, asked: Mapping[str, str]) -> str:
    health = health_of(collector)
    rows = robot_rows(collector, health)
    shown = [one for one in rows if _wanted(one, asked)]
    troubles = [
        health.trouble,
        health.disk,
        "" if collector.bundles is None else collector.bundles.publisher.trouble,
    ]
    return (
        "<h1>Robots</h1>"
        + "".join(alert(trouble) for trouble in troubles if trouble)
        + _summary(rows, health)
        + _filter(rows, asked)
        + _page_of(shown, asked)
    )


def _wanted(one: RobotRow, asked: Mapping[str, str]) -> bool:
    state = asked["state"]
    return (
        asked["name"].lower() in one.state.name
        and asked["group"] in ("", one.group)
        and (not state or state in one.words or (state == "problems" and one.rank[0] < len(_PROBLEMS)))
    )


def _summary(rows: Sequence[RobotRow], health: FleetHealth) -> str:
    found = Counter(word for one in rows for word in one.words)
    problems = sum(one.rank[0] < len(_PROBLEMS) for one in rows)
    numbers = [("", "enrolled", len(rows)), ("problems", "with problems", problems)]
    numbers += [(word, word, found[word]) for word in _SHOWN if found[word]]
    items = "".join(
        f"<li>{link('/', f'{count:,} {label}', state=state)}</li>" for state, label, count in numbers
    )
    waiting = f"<li>{counted(health.waiting, 'segment')} not yet searchable</li>" if health.waiting else ""
    return f'<ul class="figures" aria-label="Numbers">{items}{waiting}</ul>'


def _filter(rows: Sequence[RobotRow], asked: Mapping[str, str]) -> str:
    groups = sorted({one.group for one in rows if one.group})
    words = [("", "any"), ("problems", "any problem"), *((word, word) for word in _SHOWN)]
    return (
        '<form class="filter" action="/" role="search" aria-label="Robots">'
        + field("name", asked["name"])
        + choice("group", "group", [("", "any"), *((group, group) for group in groups)], asked["group"])
        + choice("state", "state", words, asked["state"])
        + "<button>Show</button></form>"
    )


def _page_of(shown: Sequence[RobotRow], asked: Mapping[str, str]) -> str:
    last = max(0, (len(shown) - 1) // ROWS)
    number = min(int(asked["page"]) if asked["page"].isdecimal() and len(asked["page"]) < 9 else 0, last)
    part = shown[number * ROWS : (number + 1) * ROWS]
    given = {name: asked[name] for name in ("name", "group", "state")}
    steps = [
        link("/", label, **given, page=str(other))
        for label, other in (("Previous", number - 1), ("Next", number + 1))
        if 0 <= other <= last
    ]
    first = number * ROWS + 1
    place = f"{first:,} to {first + len(part) - 1:,} of {len(shown):,}"
    pages = f'<nav class="pages" aria-label="Pages of robots"><span>{place}</span>{" ".join(steps)}</nav>'
    empty = (
        "No robot matches." if any(given.values()) else "No robot is enrolled: rosrv-fleet robot invite NAME"
    )
    return table("Robots", _ROBOT_COLUMNS, map(robot_row, part), empty) + (pages if last else "")


def robot_row(one: RobotRow) -> str:
    state, condition = one.state, one.condition
    site, _, group = one.group.partition("/")
    return row(
        _ROBOT_COLUMNS,
        (
            link("/search", state.name, robot=state.name),
            link(f"/rollouts/{site}/{group}", one.group) if group else '<span class="muted">none</span>',
            " ".join(badge(_TONES[word], word) for word in one.log),
            "" if state.number is None else f"{state.number:,}",
            "never" if state.age_seconds is None else ago(state.age_seconds),
            _heard(state),
            f"{state.gaps:,}",
            f"{state.forks:,}",
            "" if condition is None else badge(_TONES.get(condition.kind, "plain"), condition.kind),
            f'<span class="nowrap">{text(one.in_force)}</span>',
            "" if condition is None or condition.kind is ConditionKind.NO_BUNDLE else text(condition.why),
        ),
    )


def _heard(state: RobotState) -> str:
    found = {
        name: "never" if seconds is None else ago(seconds) for name, seconds in state.heard_seconds.items()
    }
    return "<br>".join(f"{text(name)} {when}" if len(found) > 1 else when for name, when in found.items())


# The page that lists evidence bundles.

BUNDLE_FILTERS = ("robot", "id")
_BUNDLE_COLUMNS = (
    Column("Robot"),
    Column("From"),
    Column("Until"),
    Column("Recording"),
    Column("Records", number=True),
    Column("Bytes", number=True),
    Column("Checkpoints"),
    Column("Added"),
    Column("Bundle"),
)


def evidence_page(collector: Collector, asked: Mapping[str, str], *, may_get: bool) -> str:
    stored = collector.evidence.all(asked["robot"])
    rows = (_bundle(one, may_get=may_get) for one in stored if asked["id"] in ("", one.id))
    return (
        '<h1>Evidence</h1><form class="filter" action="/evidence" role="search" aria-label="Evidence">'
        + field("robot", asked["robot"])
        + "<button>Show</button></form>"
        + table("Evidence bundles", _BUNDLE_COLUMNS, rows, "None: rosrv-fleet evidence add FILE --robot NAME")
    )


def _bundle(evidence: StoredEvidence, *, may_get: bool) -> str:
    name = evidence.id[:12]
    return row(
        _BUNDLE_COLUMNS,
        (
            link("/evidence", evidence.robot, robot=evidence.robot),
            *(text(local_time(at)) for at in (evidence.since, evidence.until)),
            text(evidence.recording),
            f"{evidence.records:,}",
            f"{evidence.bytes:,}",
            f"{evidence.collected:,} of {evidence.checkpoints:,} are collected",
            f"{moment(evidence.added / 10**9)} by {text(evidence.by)}",
            link(f"/v1/evidence/{evidence.id}", name) if may_get else text(name),
        ),
    )


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

    def show(request: Request, title: str, body: Callable[[OperatorToken], str]) -> Response:
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

    def known_group(site: str, group: str) -> RobotGroup:
        place = bundles().group(site, group)
        if place not in bundles().robots and place not in bundles().rollouts:
            raise RolloutRefusedError(
                f"no robot is enrolled in {place}: rosrv-fleet robot group NAME {place}"
            )
        return place

    @router.get("/")
    def robots(request: Request) -> Response:
        return show(request, "Robots", lambda _holder: robots_page(collector, _query(request, FLEET_FILTERS)))

    @router.get("/search")
    def search(request: Request) -> Response:
        return show(
            request, "Search", lambda viewer: search_page(collector, viewer.name, _query(request, ASKED))
        )

    @router.get("/evidence")
    def evidence(request: Request) -> Response:
        def body(holder: OperatorToken) -> str:
            asked = _query(request, BUNDLE_FILTERS)
            return evidence_page(collector, asked, may_get=holder.may(FleetRole.OPERATOR))

        return show(request, "Evidence", body)

    @router.get("/rollouts")
    def groups(request: Request) -> Response:
        return show(request, "Rollouts", lambda _holder: groups_page(bundles()))

    @router.get("/rollouts/{site}/{group}")
    def one_group(request: Request, site: Word, group: Word) -> Response:
        def body(holder: OperatorToken) -> str:
            return group_page(bundles(), known_group(site, group), may_change=holder.may(FleetRole.OPERATOR))

        return show(request, f"Rollouts of {site}/{group}", body)

    @router.get("/rollouts/{site}/{group}/{act}")
    def confirm(request: Request, site: Word, group: Word, act: Act) -> Response:
        holder = collector.tokens.holder(request.cookies.get(COOKIE, ""))
        if holder is not None and not holder.may(FleetRole.OPERATOR):
            return _forbidden(holder)

        def body(_holder: OperatorToken) -> str:
            stored = bundles().rollouts.get(known_group(site, group))
            if stored is None:
                raise RolloutRefusedError(f"there was no rollout of {site}/{group}")
            return confirm_page(known_group(site, group), act, stored)

        return show(request, f"Rollouts of {site}/{group}: {act}", body)

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
            await change(known_group(site, group), holder.name, int(number) if number.isdecimal() else -1)
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


def _query(request: Request, names: tuple[str, ...]) -> dict[str, str]:
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
