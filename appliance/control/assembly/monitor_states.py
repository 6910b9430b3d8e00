"""Describe the states of monitors for operators."""

import msgspec

from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.status import MonitorsState
from appliance.channel.messages import MonitorRow
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from appliance.specifications.judgement import broken_files
from appliance.specifications.live_topics import LiveType, Published
from appliance.specifications.specification_manager import SpecificationManager


def monitors_of(monitors: SpecificationManager, rv_state: list[object], *, texts: bool) -> answers.Monitors:
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
        on_fault=monitors.rollout.on_fault,
        slices=monitors.rollout.slices,
        **(msgspec.structs.asdict(monitors.sources) if texts else {}),
    )


def monitors_status(monitors: SpecificationManager) -> MonitorsState:
    rows, differs = states_of(monitors), monitors.differs_from_folder
    return MonitorsState(
        revision=monitors.revision,
        tag=monitors.tag,
        loaded=len(rows),
        enabled=sum(row.enabled for row in rows),
        held=[row.name for row in rows if row.held],
        failing=[row.name for row in rows if row.failing and not row.shadow],
        refused=monitors.rollout.refused,
        who=monitors.in_force.who,
        differs_from_folder=differs,
        confirm_by=monitors.confirm_by,
        shadow=[row.name for row in rows if row.shadow],
        why_held={row.name: row.why_held for row in rows if row.why_held},
        left_out=broken_files(monitors.now),
        folder_refused=monitors.now.folder_refused if differs else "",
        unbuilt={name: monitors.checked.monitors[name] for name in monitors.checked.unbuilt},
        unconfirmed={row.name: row.confirm_by for row in rows if row.confirm_by is not None},
    )


def states_of(monitors: SpecificationManager) -> list[answers.MonitorState]:
    return [_state(monitors, name) for name in monitors.names()]


def _state(monitors: SpecificationManager, name: str) -> answers.MonitorState:
    checked = monitors.checked
    row = monitors.rollout.rows.get(name) or MonitorRow(name)
    return answers.MonitorState(
        name=name,
        file=checked.monitors[name],
        enabled=monitors.switches.is_enabled(name),
        held=name in monitors.rollout.held,
        failing=row.failing,
        topics=sorted(checked.topics[name]),
        services=sorted(checked.services[name]),
        events=row.events,
        verdicts=row.verdicts,
        drops=0 if row.shadow else row.drops,
        changes=0 if row.shadow else row.changes,
        faults=row.faults,
        certificates=checked.certificates.get(name, []),
        shadow=monitors.switches.in_shadow(name),
        off_until=monitors.until(name),
        would_drop=row.drops if row.shadow else 0,
        would_change=row.changes if row.shadow else 0,
        missed=row.missed,
        slices=row.slices,
        slice_limit=row.slice_limit,
        why_held=monitors.rollout.why_held.get(name, ""),
        given=monitors.givens.states(checked, name),
        confirm_by=monitors.until(name, of=True),
        lasting=monitors.lasting(name),
        error=checked.unbuilt.get(name, ""),
    )


def published_now(registry: Registry, relayed: RelayTraffic) -> Published:
    found: dict[str, dict[str, LiveType]] = {}
    for kind, topic, nodes in registry.resources():
        if kind is Kind.PUBLICATION:
            for node in nodes:
                if not node.own:
                    carried = relayed.traffic.get((node.key, topic))
                    found.setdefault(topic, {})[node.name] = LiveType(
                        node.registrations[kind, topic].detail,
                        "" if carried is None else carried.md5sum,
                        relayed.moving(node.key, topic),
                    )
    return found
