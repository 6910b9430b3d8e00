"""How the monitors stand, for whoever looks."""

import msgspec

from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.status import MonitorsState
from appliance.channel.messages import Approach, MarginRow
from appliance.master.graph.registry import Kind, Registry
from appliance.specifications.live_topics import Published
from appliance.specifications.specifications import Monitors
from rosmop.form.positions import line_of


def monitors_of(monitors: Monitors, rv_state: list[object], *, texts: bool) -> answers.Monitors:
    """All monitors with state and counters; with `texts`, the specifications too."""
    return answers.Monitors(
        revision=monitors.revision,
        tag=monitors.tag,
        who=monitors.in_force.who,
        note=monitors.in_force.note,
        loaded=monitors.in_force.loaded,
        confirm_by=monitors.confirm_by,
        folder=str(monitors.folder) if monitors.folder is not None else None,
        differs_from_folder=monitors.differs_from_folder,
        warnings=list(monitors.checked.warnings),
        refused=monitors.rollout.refused,
        site_keys=list(monitors.site_keys),
        rv_state=msgspec.convert(rv_state, answers.RvState),
        monitors=states_of(monitors),
        **(msgspec.structs.asdict(monitors.sources) if texts else {}),
    )


def monitors_status(monitors: Monitors) -> MonitorsState:
    """The few words of `rosrv status`."""
    rows = states_of(monitors)
    return MonitorsState(
        revision=monitors.revision,
        tag=monitors.tag,
        loaded=len(rows),
        enabled=sum(row.enabled for row in rows),
        held=[row.name for row in rows if row.held],
        failing=[row.name for row in rows if row.failing and not row.trial],
        refused=monitors.rollout.refused,
        who=monitors.in_force.who,
        differs_from_folder=monitors.differs_from_folder,
        confirm_by=monitors.confirm_by,
        trials=[row.name for row in rows if row.trial],
        why_held={row.name: row.why_held for row in rows if row.why_held},
    )


def states_of(monitors: Monitors) -> list[answers.MonitorState]:
    """Every monitor, in the order in which they see messages."""
    return [_state(monitors, name) for name in monitors.names()]


def _state(monitors: Monitors, name: str) -> answers.MonitorState:
    row, checked = monitors.rollout.rows.get(name), monitors.checked
    drops, changes = (row.drops, row.changes) if row is not None else (0, 0)
    tried = row is not None and row.trial
    return answers.MonitorState(
        name=name,
        file=checked.monitors[name],
        enabled=monitors.switches.enabled(name),
        held=name in monitors.rollout.held,
        failing=row is not None and row.failing,
        topics=sorted(checked.topics[name]),
        services=sorted(checked.services[name]),
        events=row.events if row is not None else 0,
        verdicts=row.verdicts if row is not None else 0,
        drops=0 if tried else drops,
        changes=0 if tried else changes,
        faults=row.faults if row is not None else 0,
        certificates=checked.certificates.get(name, []),
        trial=monitors.switches.on_trial(name),
        shadow=monitors.switches.on_trial(name),
        off_until=monitors.returns.until(name),
        would_drop=drops if tried else 0,
        would_change=changes if tried else 0,
        missed=row.missed if row is not None else 0,
        slices=row.slices if row is not None else 0,
        slice_limit=row.slice_limit if row is not None else 0,
        why_held=monitors.rollout.why_held.get(name, ""),
        margins=[]
        if row is None
        else [_margin(margin, monitors.sources.files.get(row.file, "")) for margin in row.margins],
    )


def _margin(row: MarginRow, text: str) -> answers.MonitorMargin:
    def approach(sides: Approach) -> answers.Approach:
        reached = None if row.threshold is None else (sides.right, sides.left)[row.threshold]
        return answers.Approach(sides.time / 1e9, sides.left, sides.right, sides.distance, reached)

    today = approach(row.today) if row.today is not None else None
    return answers.MonitorMargin(
        row.line, row.column, line_of(text, row.line), row.holds, approach(row.load), today
    )


def published_now(registry: Registry) -> Published:
    """Return the nodes that publish each topic, with their types; without the appliance's own nodes."""
    found: dict[str, dict[str, str]] = {}
    for kind, topic, nodes in registry.resources():
        if kind is Kind.PUBLICATION:
            for node in nodes:
                if not node.own:
                    found.setdefault(topic, {})[node.name] = node.registrations[kind, topic].detail
    return found
