"""Decide which audit records trigger recordings (*acts*), and which recording an act begins or extends. No I/O.

Control makes the plan together with the act's audit record, which names the recording, or the reason why there is
none. The recorder finds the triggers in the audit log, so the log proves each of them, and none is missed while control
restarts. A recording is charged to the cause of its first trigger: `ROBOT`, a host or network as the policy names it,
`UNKNOWN` for all other hosts together, `OPERATORS`, or `APPLIANCE`. Times are nanoseconds since the epoch.

1. Each host has at most one open recording, and all hosts except the robot together `_MAX_AT_ONCE`. An act
   during a recording extends it, up to `longest`.
2. Each host may begin `per_hour` recordings an hour for each kind of trigger.
3. Recordings of one host do not overlap, unless an order requests one.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import without_binding
from appliance.audit.search.equality import equality_of
from appliance.base.actors import APPLIANCE, ROBOT
from appliance.features.recorder.recording_answers import (
    OPERATORS,
    OpenRecording,
    Recording,
    Trigger,
    TriggerKind,
)
from appliance.features.recorder.settings import RecorderRules

UNLIMITED = frozenset({ROBOT, OPERATORS})
"""The owners that have no quota of the disk."""

OURS = UNLIMITED | {APPLIANCE}
"""The owners whose recordings are never removed for another host's recording."""

_MAX_AT_ONCE = 2
_SECOND = 1_000_000_000
_HOUR = 3600 * _SECOND
_OBSTACLE_LASTS = 60 * _SECOND
_MAX_HOSTS = 4096  # hosts whose last recording's end, or failure, is remembered
_V = TypeVar("_V")

_BY_EVENT: dict[str, tuple[TriggerKind, ...]] = {
    "message dropped": ("drop",),
    "message changed": ("change",),
    "monitor verdict": ("verdict",),
    "monitor fault": ("fault",),
    "stop begun": ("stop", "change"),  # the message becomes the safe one
}
_LONGEST_TEXT = 300


def kinds_of(event: str, decision: str | None, severity: Severity) -> list[TriggerKind]:
    kinds = [*_BY_EVENT.get(event, ())]
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


def recording_owner(charged_to: str) -> str:
    return ROBOT if charged_to in OURS else charged_to


@dataclass(frozen=True, slots=True)
class RecordingSpan:
    """An act extends the recording to `hold` nanoseconds after it, but never beyond `latest`."""

    began: int
    ends: int
    hold: int
    latest: int

    def prolonged_end(self, now: int) -> int:
        return max(self.ends, min(now + self.hold, self.latest))


def span(
    rules: RecorderRules, now: int, ended: int, before: float | None = None, after: float | None = None
) -> RecordingSpan:
    """Return the span of a recording that an act at `now` begins. The host's last recording ended at `ended`.

    `before` and `after` are the seconds of an order, whose period may overlap the last recording.
    """
    began = now - int((rules.before if before is None else before) * _SECOND)
    hold = int((rules.after if after is None else after) * _SECOND)
    if before is None and began < ended <= now:
        began, hold = ended, max(hold, int(rules.before * _SECOND))
    latest = began + int(rules.longest * _SECOND)
    return RecordingSpan(began, min(now + hold, latest), hold, latest)


class HourlyLimit:
    """At most `most` recordings an hour for each host and kind of trigger.

    The recordings in `kept` count, so a restart does not reset the limit.
    """

    def __init__(self, most: int, kept: Iterable[Recording]) -> None:
        self._most = most
        self._begun: dict[tuple[str, str], deque[int]] = {}
        for recording in kept:
            for trigger in recording.triggers[:1]:
                self._begun.setdefault((recording.charged_to, trigger.what), deque()).append(trigger.time)

    def take(self, charged_to: str, what: TriggerKind, now: int) -> bool:
        for key, begun in list(self._begun.items()) if len(self._begun) > _MAX_HOSTS else []:
            if begun[-1] + _HOUR <= now:
                del self._begun[key]
        begun = self._begun.setdefault((charged_to, what), deque())
        while begun and not begun[0] <= now < begun[0] + _HOUR:  # drops later times: the clock was set back
            begun.popleft()
        if len(begun) >= self._most:
            return False
        begun.append(now)
        return True

    def refusal(self, charged_to: str) -> str:
        return (
            f"{charged_to} already started {self._most} recordings of this kind this hour (recorder.per_hour)"
        )


class RecordingPlan:
    """The recording of each audit record that is a trigger, or the reason why none is made."""

    def __init__(
        self, rules: RecorderRules, charged_to: Callable[[str], str], new_id: Callable[[], str]
    ) -> None:
        self._rules = rules
        self.charged_to = charged_to
        self._new_id = new_id
        self._limit = HourlyLimit(rules.per_hour, ())
        self._open: dict[str, tuple[str, RecordingSpan]] = {}
        self._ended: dict[str, int] = {}
        self._obstacles: dict[str, tuple[str, int]] = {}

    def detail(
        self, event: str, decision: str | None, severity: Severity, host: str | None, now: int
    ) -> dict[str, str]:
        wanted = [kind for kind in kinds_of(event, decision, severity) if kind in self._rules.triggers]
        if not wanted:
            return {}
        if not self._rules.enabled:
            return {"not_recorded": "the flight recorder is off (recorder.enabled)"}
        charged_to = self.charged_to(host) if host else APPLIANCE
        recording_id, why_not = self._take(wanted[0], charged_to, now)
        return (
            {"recording": recording_id, "charged_to": charged_to}
            if recording_id
            else {"not_recorded": why_not}
        )

    def _take(self, what: TriggerKind, charged_to: str, now: int) -> tuple[str, str]:
        own = recording_owner(charged_to)
        found = self._open.get(own)
        if found is not None and found[1].began <= now <= found[1].ends:
            recording_id, open_span = found
            self._open[own] = recording_id, replace(open_span, ends=open_span.prolonged_end(now))
            return recording_id, ""
        why_not, since = self._obstacles.get(own, ("", -_OBSTACLE_LASTS))
        if since <= now < since + _OBSTACLE_LASTS:  # not after the clock was set back
            return "", why_not
        others = [name for name, (_id, other) in self._open.items() if name != ROBOT and now <= other.ends]
        if own != ROBOT and len(others) >= _MAX_AT_ONCE:
            return "", f"{_MAX_AT_ONCE} recordings of other hosts are in progress"
        if not self._limit.take(charged_to, what, now):
            return "", self._limit.refusal(charged_to)
        ended = found[1].ends if found is not None else self._ended.get(own, 0)
        self._open[own] = self._new_id(), span(self._rules, now, ended)
        return self._open[own][0], ""

    # --- messages of the recorder ---

    def stated(self, recordings: Iterable[Recording], in_progress: Iterable[OpenRecording]) -> None:
        kept = list(recordings)
        self._limit = HourlyLimit(self._rules.per_hour, kept)
        for recording in kept:
            self.closed(recording)
        for making in in_progress:
            if recording_owner(making.trigger.charged_to) not in self._open:
                self.opened(making.trigger.charged_to, making.id, making.began, making.ends)

    def end_of(self, recording_id: str) -> int | None:
        return next((open_span.ends for name, open_span in self._open.values() if name == recording_id), None)

    def opened(self, charged_to: str, recording_id: str, began: int, ends: int) -> None:
        latest = began + int(self._rules.longest * _SECOND)
        self._open[recording_owner(charged_to)] = (
            recording_id,
            RecordingSpan(began, ends, int(self._rules.after * _SECOND), latest),
        )

    def closed(self, recording: Recording) -> None:
        own = recording_owner(recording.charged_to)
        self._close(own, recording.id)
        _remember(self._ended, own, max(recording.ended, self._ended.get(own, 0)))

    def missed(
        self, charged_to: str, recording_id: str, why: str, now: int, instead: OpenRecording | None = None
    ) -> None:
        """End a recording that the recorder could not make. For a minute, this owner gets no other one.

        A recording that had already ended does not count: the recorder can make the owner's next one. If it makes
        another one `instead`, further acts prolong that.
        """
        own = recording_owner(charged_to)
        if not self._close(own, recording_id):
            return
        if instead is not None:
            self.opened(charged_to, instead.id, instead.began, instead.ends)
        else:
            _remember(self._obstacles, own, (why, now))

    def _close(self, own: str, recording_id: str) -> bool:
        if own not in self._open or self._open[own][0] != recording_id:
            return False
        del self._open[own]
        return True


def _remember(of_hosts: dict[str, _V], own: str, value: _V) -> None:
    of_hosts.pop(own, None)
    of_hosts[own] = value
    if len(of_hosts) > _MAX_HOSTS:
        del of_hosts[next(iter(of_hosts))]
