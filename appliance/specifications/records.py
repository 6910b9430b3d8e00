"""Make audit records and counts from the relays' reports about monitors."""

import datetime
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from appliance.audit.log.record import Severity
from appliance.base.counted import counted
from appliance.channel.messages import MonitorEvent
from appliance.telemetry.audit_trail import AuditTrail

_EVENTS = {
    "verdict": ("monitor verdict", Severity.NOTICE),
    "drop": ("message dropped", Severity.WARNING),
    "change": ("message changed", Severity.NOTICE),
    "fault": ("monitor fault", Severity.ALARM),
    "log": ("monitor log", Severity.INFO),
    "publish": ("monitor published", Severity.INFO),
    "call": ("monitor called", Severity.INFO),
}
_SHADOW_KINDS = {f"shadow {kind}": kind for kind in (*_EVENTS, "missed")}
_NOT_DONE = ("drop", "change", "publish", "call")
_SENT = {"publish": "sends", "call": "calls"}
KINDS = tuple(_EVENTS)
_LEVELS = {"WARN": Severity.WARNING, "ERROR": Severity.WARNING, "FATAL": Severity.ALARM}


@dataclass(frozen=True, slots=True)
class MonitorRecords:
    """Makes the records and counts; each callback in `told` gets every event.

    A change by several monitors counts for each in `counts`, and once for its topic in `at`.
    """

    trail: AuditTrail
    fields: Callable[[str, bytes], dict[str, Any] | None]
    told: list[Callable[[MonitorEvent], None]]
    counts: Counter[tuple[str, str]] = field(default_factory=Counter, init=False)
    at: Counter[tuple[str, str]] = field(default_factory=Counter, init=False)

    def reported(self, events: list[MonitorEvent], lost: int) -> None:
        for event in events:
            for monitor in _monitors(event):
                self.counts[event.kind, monitor] += event.count or 1
                if event.kind == "drop":
                    self.trail.meter.dropped.add(monitor, event.count or 1)
            if event.kind in ("drop", "change"):
                self.at[event.kind, event.resource] += event.count or 1
            self._record(event)
            for tell in tuple(self.told):  # one may remove itself
                tell(event)
        if lost:
            text = (
                f"{counted(lost, 'report of a monitor was', 'reports of monitors were')} lost while control"
                " was not running"
            )
            self.trail.happened("records lost", text, lost=lost)

    def _record(self, event: MonitorEvent) -> None:
        name, severity = _EVENTS.get(event.kind, ("monitor log", Severity.INFO))
        detail: dict[str, Any] = {"monitor": event.monitor}
        shadowed = _SHADOW_KINDS.get(event.kind)
        if shadowed is not None:
            name, severity = "shadow observed", Severity.INFO
            detail |= {"shadow": True, "would": shadowed}
        detail["happened"] = datetime.datetime.fromtimestamp(event.time / 1e9, datetime.UTC).isoformat()
        if event.kind == "log":
            severity = _LEVELS.get(str(event.detail.get("level")), severity)
        for word, data in (("before", event.before), ("after", event.after)):
            if data:
                detail[word] = data.hex()
                read = self.fields(event.resource, data)
                if read is not None:
                    detail[f"{word}_fields"] = read
        if event.size:
            detail["size"] = event.size
        text = event.text
        if shadowed in _SENT:
            text = f"{event.monitor} {_SENT[shadowed]} {text}"
        if event.count:
            detail["count"] = event.count
            text = f"{event.count} more in the same second" + (f": {text}" if text else "")
        if shadowed is not None:
            text = f"in shadow mode, not done: {text}" if shadowed in _NOT_DONE else f"in shadow mode: {text}"
        self.trail.happened(
            name,
            text,
            severity=severity,
            host=event.host or None,
            caller_id=event.caller_id or None,
            category="monitor",
            resource=event.resource,
            more=event.detail,
            **detail,
        )


def _monitors(event: MonitorEvent) -> set[str]:
    together = event.detail.get("changed_by", ())
    return {event.monitor, *(str(other).partition(".")[0] for other in together)}
