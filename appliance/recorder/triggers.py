"""Which audit records are reasons to record messages.

The recorder reads the audit log as any reviewer does. So a trigger is always something that the log proves, and none is
missed while control dies and comes back.
"""

from collections.abc import Collection

from appliance.audit.record import Record, Severity
from appliance.audit.record_format import without_binding
from appliance.channel.answers.recording_answers import APPLIANCE, Trigger, TriggerKind

_BY_EVENT: dict[str, TriggerKind] = {
    "message dropped": "drop",
    "message changed": "change",
    "monitor verdict": "verdict",
    "monitor fault": "fault",
}
_LONGEST_TEXT = 300


def kinds_of(event: str, decision: str | None, severity: Severity) -> list[TriggerKind]:
    """What a record may trigger as; empty when it is no trigger."""
    kinds: list[TriggerKind] = [_BY_EVENT[event]] if event in _BY_EVENT else []
    if decision == "deny":
        kinds.append("denial")
    if severity is Severity.ALARM:
        kinds.append("alarm")
    return kinds


def trigger_of(record: Record, wanted: Collection[TriggerKind]) -> Trigger | None:
    """The record as a trigger of one of the kinds that are wanted; None when it is none."""
    for what in kinds_of(record.event, record.decision, record.severity):
        if what in wanted:
            reason = without_binding(record.reason, record.detail)
            text = f"{record.event}: {reason}" if reason else record.event
            charged_to = str(record.detail.get("charged_to", APPLIANCE))
            return Trigger(record.time, what, record.id, text[:_LONGEST_TEXT], charged_to)
    return None
