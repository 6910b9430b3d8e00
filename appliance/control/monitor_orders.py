"""What operators ask of the monitors, over the admin socket and REST alike."""

from typing import Any

from appliance.channel import admin
from appliance.control.assembly import Parts
from appliance.specifications.monitors import Monitors, Replaced


async def change_monitors(monitors: Monitors, request: admin.MonitorChange, who: str) -> dict[str, Any]:
    """Carry out a change; what it did."""
    match request:
        case admin.MonitorLoad(files, definitions, note, expected):
            loaded = await monitors.load(files, definitions, who=who, note=note, expected=expected)
            return _replaced(loaded, monitors.tag)
        case admin.MonitorReplace(name, text, definitions, note, expected):
            file = monitors.file_of(name)
            loaded = await monitors.load({file: text}, definitions, who=who, note=note, expected=expected)
            return _replaced(loaded, monitors.tag)
        case admin.MonitorReload(expected, prune):
            return _replaced(await monitors.reload(who=who, expected=expected, prune=prune), monitors.tag)
        case admin.MonitorRemove(names, expected):
            return _replaced(await monitors.remove(names, who=who, expected=expected), monitors.tag)
        case admin.MonitorSwitch(names, enabled, expected):
            changed = await monitors.switch(names, enabled, who=who, expected=expected)
            return {"names": changed, "enabled": enabled, "revision": monitors.revision, "tag": monitors.tag}
        case admin.MonitorResume(names, expected):
            held = await monitors.resume(names, who=who, expected=expected)
            return {"names": held, "revision": monitors.revision, "tag": monitors.tag}


def monitors_body(parts: Parts, *, texts: bool) -> dict[str, Any]:
    """All monitors with state and counters; with `texts`, the specifications too."""
    monitors = parts.monitors
    body: dict[str, Any] = {
        "revision": monitors.revision,
        "tag": monitors.tag,
        "who": monitors.who,
        "note": monitors.note,
        "loaded": monitors.loaded,
        "folder": str(monitors.folder) if monitors.folder is not None else None,
        "differs_from_folder": monitors.differs_from_folder,
        "warnings": list(monitors.checked.warnings),
        "refused": monitors.refused,
        "rv_state": parts.monitor_calls.rv_state(),
        "monitors": [_row(monitors, name) for name in monitors.names()],
    }
    if texts:
        body["files"] = monitors.sources.files
        body["definitions"] = monitors.sources.definitions
    return body


def monitors_status(monitors: Monitors) -> dict[str, Any]:
    """The few words of `rosrv status`."""
    rows = [_row(monitors, name) for name in monitors.names()]
    return {
        "revision": monitors.revision,
        "tag": monitors.tag,
        "loaded": len(rows),
        "enabled": sum(row["enabled"] for row in rows),
        "held": [row["name"] for row in rows if row["held"]],
        "failing": [row["name"] for row in rows if row["failing"]],
        "refused": monitors.refused,
        "who": monitors.who,
        "differs_from_folder": monitors.differs_from_folder,
    }


def _row(monitors: Monitors, name: str) -> dict[str, Any]:
    row = monitors.rows.get(name)
    checked = monitors.checked
    return {
        "name": name,
        "file": checked.monitors[name],
        "enabled": monitors.enabled(name),
        "held": name in monitors.held,
        "failing": row is not None and row.failing,
        "topics": sorted(checked.topics[name]),
        "services": sorted(checked.services[name]),
        "events": row.events if row is not None else 0,
        "verdicts": row.verdicts if row is not None else 0,
        "drops": row.drops if row is not None else 0,
        "changes": row.changes if row is not None else 0,
        "faults": row.faults if row is not None else 0,
    }


def _replaced(replaced: Replaced, tag: str) -> dict[str, Any]:
    return {
        "revision": replaced.revision,
        "tag": tag,
        "replaced": replaced.replaced,
        "added": replaced.added,
        "changed": replaced.changed,
        "removed": replaced.removed,
        "warnings": replaced.warnings,
        "moved": replaced.moved,
        "began": replaced.began,
        "kept": replaced.kept,
    }
