"""The pages of rollouts: all groups, one group, and the confirmation of a stop or revert."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from psycopg import Error as DatabaseError

from appliance.base.counted import counted
from rosrv_fleet.console.frame import Column, Tone, alert, badge, link, moment, row, since, table, text
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.rollouts.machine import OperatorAct
from rosrv_fleet.rollouts.operator_routes import group_state
from rosrv_fleet.rollouts.service import BundleService, ConditionKind
from rosrv_fleet.rollouts.store import StoredRollout

Act = Literal["stop", "revert"]
_KINDS = tuple(ConditionKind)
_GROUPS = (
    Column("Group"),
    Column("Robots", number=True),
    *(Column(kind.value.capitalize(), number=True) for kind in _KINDS),
    Column("Last rollout"),
    Column("State"),
    Column("Reason"),
)
_RINGS = (
    Column("Ring"),
    Column("State"),
    Column("Robots", number=True),
    Column("In force", number=True),
    Column("Refused", number=True),
    Column("Unhealthy", number=True),
)
_ROBOTS = (
    Column("Robot"),
    Column("State"),
    Column("In force"),
    Column("Reported", number=True),
    Column("Reason"),
)
_HISTORY = (Column("Number"), Column("Bundle"), Column("State"), Column("Operators"), Column("Reason"))
_STATES: dict[str, Tone] = {"running": "plain", "done": "good", "stopped": "bad", "reverted": "warn"}
_BAD = {ConditionKind.UNHEALTHY: "bad", ConditionKind.SILENT: "bad", ConditionKind.IN_FORCE: "good"}
_MAX_ROBOTS = 50
_MAX_HISTORY = 20


def groups_page(service: BundleService) -> str:
    groups = sorted({*service.rollouts, *service.robots})
    publisher = service.publisher
    trouble = alert(publisher.trouble) if publisher.trouble else ""
    if not service.advancing:
        trouble += alert("No rollout advances; the collector's log has the reason.")
    empty = "No robot is in a group: rosrv-fleet robot group NAME SITE/GROUP"
    expires = "" if publisher.expires is None else _expires(publisher.expires)
    return f"<h1>Rollouts</h1>{trouble}{expires}" + table(
        "Groups", _GROUPS, (_group(group_state(service, group)) for group in groups), empty
    )


def _expires(at: float) -> str:
    return f'<p class="muted">The signed metadata expire at {moment(at)}.</p>'


def _group(state: dict[str, Any]) -> str:
    rollout = state["rollout"]
    place = f"{state['site']}/{state['group']}"
    return row(
        _GROUPS,
        (
            link(f"/rollouts/{place}", place),
            f"{state['robots_known']:,}",
            *(f"{state['conditions'][kind]:,}" for kind in _KINDS),
            "none" if rollout is None else text(rollout["bundle"]),
            "" if rollout is None else badge(_STATES[rollout["state"]], rollout["state"]),
            "" if rollout is None else text(rollout["why"]),
        ),
    )


def group_page(service: BundleService, group: RobotGroup, *, may_change: bool) -> str:
    state = group_state(service, group)
    head = f"<h1>Rollouts of {text(group)}</h1>"
    if state["rollout"] is None:
        start = f"rosrv-fleet rollout start {text(group)}/1.tar"
        head += f"<p>{counted(state['robots_known'], 'robot')}, no rollout yet: <code>{start}</code></p>"
    else:
        head += _rollout(group, state["rollout"], may_change=may_change)
    return head + _robots(service, group) + _history(service, group)


def _rollout(group: RobotGroup, rollout: Mapping[str, Any], *, may_change: bool) -> str:
    acts: list[Act] = ["stop"] if rollout["state"] == "running" else []
    if rollout["before"] and rollout["state"] != "reverted":
        acts.append("revert")
    buttons = "".join(
        f'<a class="button danger" href="/rollouts/{text(group)}/{act}">{act.capitalize()}…</a>'
        for act in acts
    )
    before = f", over {text(rollout['before'])}" if rollout["before"] else ""
    rings = (
        row(
            _RINGS,
            (
                text(ring["name"]),
                badge("good", "open") if ring["open"] else badge("plain", "not open"),
                *(f"{ring[name]:,}" for name in ("robots", "in_force", "refused", "unhealthy")),
            ),
        )
        for ring in rollout["rings"]
    )
    return (
        f"<p>{badge(_STATES[rollout['state']], rollout['state'])} {text(rollout['bundle'])}: {text(rollout['why'])}</p>"
        f'<p class="muted">Started {since(rollout["started"])}{before}.</p>'
        + (f'<p class="buttons">{buttons}</p>' if may_change and buttons else "")
        + table("Rings", _RINGS, rings, "")
    )


def _robots(service: BundleService, group: RobotGroup) -> str:
    seen, found = service.robots.get(group, {}), service.conditions(group)
    order = sorted(
        (name for name in found if name in seen), key=lambda name: (_KINDS.index(found[name].kind), name)
    )
    rows = (
        row(
            _ROBOTS,
            (
                link("/search", name, robot=name),
                badge(_BAD.get(found[name].kind, "warn"), found[name].kind),  # type: ignore[arg-type]  # tones
                text(seen[name].in_force or "none"),
                since(seen[name].seen) if seen[name].seen else "never",
                text(found[name].why),
            ),
        )
        for name in order[:_MAX_ROBOTS]
    )
    more = ""
    if len(order) > _MAX_ROBOTS:
        every = f"All {counted(len(order), 'robot')} of the group"
        more = f"<p>{link('/', every, group=str(group))}</p>"
    return table("Robots, problems first", _ROBOTS, rows, "No robot is enrolled in this group.") + more


def _history(service: BundleService, group: RobotGroup) -> str:
    try:
        stored = service.store.history(group, _MAX_HISTORY)
    except DatabaseError:
        return alert("The history is not available: the database is unreachable.")
    return table("History", _HISTORY, map(_past, stored), "There was no rollout.")


def _past(stored: StoredRollout) -> str:
    rollout = stored.rollout
    return row(
        _HISTORY,
        (
            f"{stored.number}",
            text(rollout.path),
            badge(_STATES[rollout.state], rollout.state),
            _acts(rollout.acts),
            text(rollout.why),
        ),
    )


def _acts(acts: Sequence[OperatorAct]) -> str:
    return "<br>".join(f"{act.act} by {text(act.who)}, {moment(act.at)}" for act in acts)


_EFFECTS: dict[Act, str] = {
    "stop": "No further robot gets this bundle. Robots that have it keep it. A stopped rollout never continues.",
    "revert": "All robots of the group get the bundle from before, if it is still signed.",
}


def confirm_page(group: RobotGroup, act: Act, stored: StoredRollout) -> str:
    rollout = stored.rollout
    back = f"<p>All robots get {text(rollout.before or 'no bundle')}.</p>" if act == "revert" else ""
    return (
        f"<h1>Rollouts of {text(group)}: {act}</h1>"
        f"<p>{badge(_STATES[rollout.state], rollout.state)} {text(rollout.path)}: {text(rollout.why)}</p>"
        f"<p>{_EFFECTS[act]}</p>{back}"
        f'<form method="post" action="/rollouts/{text(group)}/{act}" class="buttons">'
        f'<input type="hidden" name="number" value="{stored.number}">'
        f'<button class="danger">{act.capitalize()} the rollout</button>'
        f'<a class="button" href="/rollouts/{text(group)}">Cancel</a></form>'
    )
