"""The page of the robots, problems first, with a filter and a hundred rows a page."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from appliance.base.counted import counted
from rosrv_fleet.collector import Collector
from rosrv_fleet.console.frame import Column, Tone, ago, alert, badge, choice, field, link, row, table, text
from rosrv_fleet.health import FleetHealth, RobotState, health_of
from rosrv_fleet.rollouts.conditions import ConditionKind, RobotCondition
from rosrv_fleet.rollouts.service import BundleService

ROWS = 100
FILTERS = ("name", "group", "state", "page")
_COLUMNS = (
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
        + choice("group", "group", [("", "any"), *((one, one) for one in groups)], asked["group"])
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
    return table("Robots", _COLUMNS, map(robot_row, part), empty) + (pages if last else "")


def robot_row(one: RobotRow) -> str:
    state, condition = one.state, one.condition
    site, _, group = one.group.partition("/")
    return row(
        _COLUMNS,
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
