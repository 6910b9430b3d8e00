"""Which audit records are reasons to record messages, and how often each kind of them may begin a recording.

The recorder reads the audit log as any reviewer does. So a trigger is always something that the log proves, and none is
missed while control dies and comes back.
"""

from collections import deque
from collections.abc import Collection, Iterable

from appliance.audit.output import without_binding
from appliance.audit.record import Record, Severity
from appliance.channel.answers.recordings import Recording, Trigger, TriggerKind

_BY_EVENT: dict[str, TriggerKind] = {
    "message dropped": "drop",
    "message changed": "change",
    "monitor verdict": "verdict",
    "monitor fault": "fault",
}
_HOUR = 3600 * 1_000_000_000
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
            return Trigger(record.time, what, record.id, text[:_LONGEST_TEXT])
    return None


class HourlyLimit:
    """Each kind of trigger may begin `most` recordings within an hour, so that a flood of one hides no other."""

    def __init__(self, most: int, kept: Iterable[Recording]) -> None:
        """`kept` are the recordings that there are: a new recorder grants no new hour."""
        self._most = most
        self._begun: dict[str, deque[int]] = {}
        for recording in kept:
            for trigger in recording.triggers[:1]:
                self._of(trigger.what).append(trigger.time)

    def take(self, what: TriggerKind, now: int) -> bool:
        """Whether a recording may begin now (nanoseconds since the epoch); then it counts."""
        begun = self._of(what)
        while begun and not begun[0] <= now < begun[0] + _HOUR:  # or the clock was set back
            begun.popleft()
        if len(begun) >= self._most:
            return False
        begun.append(now)
        return True

    def _of(self, what: TriggerKind) -> deque[int]:
        return self._begun.setdefault(what, deque())
