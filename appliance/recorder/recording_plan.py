"""Which recording an act begins or prolongs, and whose it is. No I/O; time is given, in nanoseconds since the epoch.

Control makes the plan when it makes the audit record of the act, so the record says which recording has it, or why
there is none; the recorder reads the log and carries the plan out. Recordings are charged to the host whose act
triggered them: to `ROBOT`, to a host or network as the policy names it, to `UNKNOWN` for all other hosts together, to
`OPERATORS` for orders, to `APPLIANCE` for what no host did (a timer of a monitor).

Invariants:

1. Each host has one recording that is open at most; the robot, operators and the appliance have one together (`lane`).
   An act in its time prolongs it, up to `longest`.
2. Each may begin `per_hour` recordings an hour by each kind of trigger, and has no part in those of another.
3. Recordings of one host do not overlap. The next one that would begins where the last one ended, and holds on for as
   long as the memory goes back: acts that recur are in one recording after the first.
4. Hosts but the robot's have `_MOST_AT_ONCE` open recordings together.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from appliance.audit.record import Severity
from appliance.channel.answers.recording_answers import APPLIANCE, OPERATORS, ROBOT, Recording, TriggerKind
from appliance.configuration.settings import RecorderRules
from appliance.recorder.triggers import kinds_of

KEPT = frozenset({ROBOT, OPERATORS})
"""Recordings charged to these make room for no other host's."""

_OURS = KEPT | {APPLIANCE}
_MOST_AT_ONCE = 2
_SECOND = 1_000_000_000
_HOUR = 3600 * _SECOND
_MOST_HOSTS = 4096  # of which it is remembered when their last recording ended


def lane(charged_to: str) -> str:
    """In whose open recording an act is that is charged so: hosts have nothing to do with those of others."""
    return ROBOT if charged_to in _OURS else charged_to


@dataclass(frozen=True, slots=True)
class Span:
    """The time of a recording: an act prolongs it to `hold` after itself, and never beyond `latest`."""

    began: int
    ends: int
    hold: int
    latest: int

    def prolonged(self, now: int) -> int:
        """When it ends after an act now."""
        return max(self.ends, min(now + self.hold, self.latest))


def span(
    rules: RecorderRules, now: int, ended: int, before: float | None = None, after: float | None = None
) -> Span:
    """The time of a recording that begins because of an act now; the last one of the same host ended at `ended`.

    `before` and `after` are the seconds of an order, which is carried out as it is.
    """
    began = now - int((rules.before if before is None else before) * _SECOND)
    hold = int((rules.after if after is None else after) * _SECOND)
    if before is None and began < ended <= now:
        began, hold = ended, max(hold, int(rules.before * _SECOND))
    latest = began + int(rules.longest * _SECOND)
    return Span(began, min(now + hold, latest), hold, latest)


class HourlyLimit:
    """Each host may begin `most` recordings an hour by each kind of trigger: a flood of one hides no other."""

    def __init__(self, most: int, kept: Iterable[Recording]) -> None:
        """`kept` are the recordings that there are: another process grants no new hour."""
        self._most = most
        self._begun: dict[tuple[str, str], deque[int]] = {}
        for recording in kept:
            for trigger in recording.triggers[:1]:
                self._begun.setdefault((recording.charged_to, trigger.what), deque()).append(trigger.time)

    def take(self, charged_to: str, what: TriggerKind, now: int) -> bool:
        """Whether a recording may begin now; then it counts."""
        for key, begun in list(self._begun.items()) if len(self._begun) > _MOST_HOSTS else []:
            if begun[-1] + _HOUR <= now:
                del self._begun[key]
        begun = self._begun.setdefault((charged_to, what), deque())
        while begun and not begun[0] <= now < begun[0] + _HOUR:  # or the clock was set back
            begun.popleft()
        if len(begun) >= self._most:
            return False
        begun.append(now)
        return True

    def refusal(self, charged_to: str) -> str:
        """Why `take` returned False, in words."""
        return f"{charged_to} has begun its {self._most} recordings of this kind in this hour (recorder.per_hour)"


class RecordingPlan:
    """Says for each audit record that is a trigger which recording has it, or why there is none.

    `charged_to(host)` is the name by which recordings of a host's acts are charged; `new_id` makes ids of recordings.
    """

    def __init__(
        self, rules: RecorderRules, charged_to: Callable[[str], str], new_id: Callable[[], str]
    ) -> None:
        self._rules = rules
        self.charged_to = charged_to
        self._new_id = new_id
        self._limit = HourlyLimit(rules.per_hour, ())
        self._open: dict[str, tuple[str, Span]] = {}
        self._ended: dict[str, int] = {}
        self._obstacle = ("", 0)

    def detail(
        self, event: str, decision: str | None, severity: Severity, host: str | None, now: int
    ) -> dict[str, str]:
        """What the record of this event says of recordings; empty when it is no trigger."""
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
        """The recording that has an act of this host, or why there is none."""
        own = lane(charged_to)
        found = self._open.get(own)
        if found is not None and found[1].began <= now <= found[1].ends:
            recording_id, open_span = found
            self._open[own] = recording_id, replace(open_span, ends=open_span.prolonged(now))
            return recording_id, ""
        why_not, until = self._obstacle
        if now < until:
            return "", why_not
        others = [name for name, (_id, other) in self._open.items() if name != ROBOT and now <= other.ends]
        if own != ROBOT and len(others) >= _MOST_AT_ONCE:
            return "", f"{_MOST_AT_ONCE} recordings of other hosts are being made"
        if not self._limit.take(charged_to, what, now):
            return "", self._limit.refusal(charged_to)
        ended = found[1].ends if found is not None else self._ended.get(own, 0)
        self._open[own] = self._new_id(), span(self._rules, now, ended)
        return self._open[own][0], ""

    # --- what the recorder says ---

    def stated(self, recordings: Iterable[Recording]) -> None:
        """These are kept: they count, also after another start of control."""
        kept = list(recordings)
        self._limit = HourlyLimit(self._rules.per_hour, kept)
        for recording in kept:
            self.closed(recording)

    def opened(self, charged_to: str, recording_id: str, began: int, ends: int) -> None:
        """The recorder has begun or prolonged this one because of an order or a call."""
        latest = began + int(self._rules.longest * _SECOND)
        self._open[lane(charged_to)] = (
            recording_id,
            Span(began, ends, int(self._rules.after * _SECOND), latest),
        )

    def closed(self, recording: Recording) -> None:
        """This one is over."""
        own = lane(recording.charged_to)
        self._close(own, recording.id)
        self._ended[own] = max(recording.ended, self._ended.pop(own, 0))
        if len(self._ended) > _MOST_HOSTS:
            del self._ended[next(iter(self._ended))]

    def missed(self, charged_to: str, recording_id: str, why: str, now: int) -> None:
        """The recorder could not make this one; the same is said of what happens within a minute."""
        self._close(lane(charged_to), recording_id)
        self._obstacle = why, now + 60 * _SECOND

    def _close(self, own: str, recording_id: str) -> None:
        if own in self._open and self._open[own][0] == recording_id:
            del self._open[own]
