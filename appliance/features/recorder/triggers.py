"""Decide which audit records trigger a recording.

The recorder finds triggers in the audit log, so the log proves each trigger, and none is missed while control
restarts.
"""

from collections.abc import Collection

from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import without_binding
from appliance.audit.search.equality import equality_of
from appliance.base.actors import APPLIANCE
from appliance.features.recorder.recording_answers import Trigger, TriggerKind

_BY_EVENT: dict[str, TriggerKind] = {
    "message dropped": "drop",
    "message changed": "change",
    "monitor verdict": "verdict",
    "monitor fault": "fault",
}
_LONGEST_TEXT = 300


def kinds_of(event: str, decision: str | None, severity: Severity) -> list[TriggerKind]:
    kinds: list[TriggerKind] = [_BY_EVENT[event]] if event in _BY_EVENT else []
    if decision == "deny":
        kinds.append("denial")
    if severity is Severity.ALARM:
        kinds.append("alarm")
    return kinds


def trigger_of(record: AuditRecord, wanted: Collection[TriggerKind]) -> Trigger | None:
    for what in kinds_of(record.event, record.decision, record.severity):
        if what in wanted:
            reason = without_binding(record.reason, record.detail)
            text = f"{record.event}: {reason}" if reason else record.event
            charged_to = str(record.detail.get("charged_to", APPLIANCE))
            equality = equality_of(record)
            return Trigger(
                record.time,
                what,
                record.id,
                text[:_LONGEST_TEXT],
                charged_to,
                monitor=_short(record.detail.get("monitor")),
                resource=_short(record.resource),
                host=_short(record.host),
                caller_id=_short(record.caller_id),
                equal=f"{equality['key']} {equality['reason']}",
            )
    return None


def _short(value: object) -> str:
    return "" if value is None else str(value)[:_LONGEST_TEXT]
