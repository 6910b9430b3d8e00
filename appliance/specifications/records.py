"""Make audit records and counts from the relays' reports about monitors."""

import datetime
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import msgspec

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.varying_numbers import without_numbers
from appliance.channel.messages import MonitorEvent
from appliance.telemetry.audit_trail import AuditTrail

# Fold what monitors go on doing, so that the audit log has few records of it, and their whole number.
#
# - An action that goes on is recorded as before for ten seconds: in each second the first in full, the others as a
# count.
#   Then at most once a minute, with the number since the last record; the last record has the whole number and the
#   time.
# - Rare actions are recorded in full: each kind of action of a monitor on a topic has 20 records at once, and one
# more a
#   minute.
# - A stop, which sends the safe message of a monitor or puts it in the place of messages, is one record at its begin
# and
#   one at its end. Stops that follow each other closely become one, so they also have at most one record a minute.
#
# Times of actions are those of the monitors' clock (nanoseconds), which runs evenly; `now` is monotonic (seconds).

RECORDS = 20.0
"""The records of a kind of action that may follow at once: those of ten seconds."""

PERIOD = 60.0
"""The seconds after which a kind of action may have one more record."""

QUIET = 2.5
"""The seconds without an action after which it has ended. Relays report once a second."""

STOPS = 5.0
"""The stops of a monitor on a topic that may follow at once, each with two records."""

LONG_QUIET = 2 * PERIOD
"""The seconds without an action after which a stop has ended, if many stops have preceded it closely."""

_MAX = 1000
_BY_TEXT = frozenset({"verdict", "fault", "log", "missed"})


class StoppedTopic(msgspec.Struct, frozen=True):
    """A stop: a monitor that keeps a topic at its safe message.

    Times are nanoseconds since the epoch by the clock of monitors, which no step of the system clock changes; that one
    is `ahead` of it.
    """

    monitor: str
    topic: str
    since: int
    until: int
    count: int
    cause: str = ""
    host: str = ""
    node: str = ""
    record: str = ""
    """The record of its begin."""
    publisher: tuple[str, str] = ("", "")
    """Host and node of the topic's only publisher, or of the last one that has ended, if a timer led to the stop."""
    present: str = ""
    """The cause that its last report had, while it goes on: that of the begin may have ended."""
    ahead: int = 0

    @property
    def span(self) -> tuple[int, int]:
        """Return the times of its first and last action by the system clock, for people."""
        return self.since + self.ahead, self.until + self.ahead


@dataclass(slots=True)
class _Allowance:
    """The records that may be made now; `most` at once, and one more each `period` seconds."""

    most: float
    period: float
    left: float
    at: float

    def take(self, now: float) -> bool:
        self.left = min(self.most, self.left + max(0.0, now - self.at) / self.period)
        self.at = now
        if self.left < 1:
            return False
        self.left -= 1
        return True

    def full(self, now: float) -> bool:
        return self.left + max(0.0, now - self.at) / self.period >= self.most


@dataclass(slots=True)
class _GoingOn:
    """An action that goes on; `waits` is its last report, and stands for `count` actions since `first`."""

    allowance: _Allowance
    begun: int
    last: int
    at: float
    total: int = 0
    count: int = 0
    first: int = 0
    waits: MonitorEvent | None = None


class Repetitions:
    """Counts repeated actions of monitors, which have one audit record for a time.

    The kinds of a host may be as many as are left for others; its further ones are counted together.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[str, ...], _GoingOn] = {}
        self._of_host = Counter[str]()

    @property
    def some(self) -> bool:
        return bool(self._known)

    @property
    def waits(self) -> bool:
        """Return whether an action is counted that no record has yet."""
        return any(known.waits is not None for known in self._known.values())

    def take(self, event: MonitorEvent, now: float) -> MonitorEvent | None:
        """Return the report to record now, if any; it stands for all actions since the last record."""
        key = self._key(event)
        if key[3] != event.host:  # it stands for many hosts
            event = msgspec.structs.replace(event, host="", caller_id="")
        known = self._known.get(key)
        self._of_host[key[3]] += known is None
        if known is None or now - known.at > PERIOD:
            allowance = _Allowance(RECORDS, PERIOD, RECORDS, now) if known is None else known.allowance
            known = self._known[key] = _GoingOn(allowance, event.time, event.time, now)
        known.at, known.last = now, max(known.last, event.time)
        number = event.count or 1
        known.total += number
        if not known.count:
            known.first = event.first or event.time
        known.count += number
        if not known.allowance.take(now):
            known.waits = event
            return None
        known.waits = None
        if known.count > number:
            return _counted(event, known)
        known.count = 0
        return event

    def pop_ended(self, now: float) -> Iterator[tuple[MonitorEvent, dict[str, float]]]:
        """Yield the last reports of actions that have ended, and their whole number (`total`) and time in seconds."""
        for key, known in list(self._known.items()):
            quiet = now - known.at >= QUIET
            if known.waits is not None and quiet and known.allowance.take(now):
                seconds = round((known.last - known.begun) / 1e9, 3)
                yield _counted(known.waits, known), {"total": known.total, "seconds": seconds}
                known.waits = None
            if known.waits is None and quiet and known.allowance.full(now):
                del self._known[key]
                self._of_host -= Counter([key[3]])

    def _key(self, event: MonitorEvent) -> tuple[str, ...]:
        kind = event.kind.removeprefix("shadow ")
        text = without_numbers(event.text) if kind in _BY_TEXT else ""
        known, host = len(self._known), event.host
        key = (event.kind, event.monitor, event.resource, host, text)
        if key in self._known or self._of_host[host] < _MAX - known:
            return key
        together = (event.kind, event.monitor, "", host)
        return (
            together if together in self._known or known < 2 * _MAX else (event.kind, event.monitor, "", "")
        )


@dataclass(slots=True)
class _Going:
    """A stop that goes on, and after how many seconds without an action it has ended."""

    stop: StoppedTopic
    at: float
    quiet: float


class Stops:
    """The stops that go on, and the last one of each monitor; `keep(stops)` stores those that go on."""

    def __init__(self, keep: Callable[[list[StoppedTopic]], None]) -> None:
        self._keep = keep
        self._going: dict[tuple[str, str], _Going] = {}
        self._allowances: dict[tuple[str, str], _Allowance] = {}
        self.last: dict[str, StoppedTopic] = {}

    @property
    def some(self) -> bool:
        return bool(self._going)

    def goes_on(self, monitor: str) -> bool:
        return any(stop.monitor == monitor for stop in self.going())

    def going(self) -> list[StoppedTopic]:
        return [going.stop for going in self._going.values()]

    def take(self, event: MonitorEvent, now: float, ahead: int) -> StoppedTopic | None:
        """Return the stop if it begins with this event."""
        cause = str(event.detail.get("cause", ""))
        key, last = (event.monitor, event.resource), event.time
        going = self._going.get(key)
        if going is not None:
            stop = going.stop
            count, until = stop.count + (event.count or 1), max(stop.until, last)
            going.stop = self.last[event.monitor] = msgspec.structs.replace(
                stop,
                count=count,
                until=until,
                cause=stop.cause or cause,
                present=cause or stop.present,
                ahead=ahead,
            )
            going.at = now
            return None
        if key not in self._allowances and len(self._allowances) >= _MAX:
            self._allowances = {one: each for one, each in self._allowances.items() if not each.full(now)}
        allowance = self._allowances.setdefault(key, _Allowance(STOPS, LONG_QUIET, STOPS, now))
        topic = StoppedTopic(
            *key,
            event.first or last,
            last,
            event.count or 1,
            cause,
            event.host,
            event.caller_id,
            publisher=_only(event),
            present=cause,
            ahead=ahead,
        )
        self._going[key] = _Going(topic, now, QUIET if allowance.take(now) else LONG_QUIET)
        self.last[event.monitor] = topic
        return topic

    def note_record(self, stop: StoppedTopic, record: str) -> None:
        going = self._going[stop.monitor, stop.topic]
        going.stop = self.last[stop.monitor] = msgspec.structs.replace(going.stop, record=record)
        self._keep(self.going())

    def pop_ended(self, now: float) -> list[StoppedTopic]:
        ended = [key for key, going in self._going.items() if now - going.at >= going.quiet]
        stops = [self._going.pop(key).stop for key in ended]
        if stops:
            self._keep(self.going())
        return stops


def _only(event: MonitorEvent) -> tuple[str, str]:
    match event.detail.get("publishers"):
        case [{"host": str(host), "node": str(node)}]:
            return host, node
    return "", ""


def _counted(event: MonitorEvent, known: _GoingOn) -> MonitorEvent:
    counted = msgspec.structs.replace(event, count=known.count, first=known.first, time=known.last)
    known.count = 0
    return counted


_EVENTS = {
    "verdict": ("monitor verdict", Severity.NOTICE),
    "drop": ("message dropped", Severity.WARNING),
    "change": ("message changed", Severity.NOTICE),
    "fault": ("monitor fault", Severity.ALARM),
    "log": ("monitor log", Severity.INFO),
    "publish": ("monitor published", Severity.INFO),
    "call": ("monitor called", Severity.INFO),
}
_STOP = ("stop begun", Severity.WARNING)
_SECOND = 1_000_000_000
_SHADOW_KINDS = {f"shadow {kind}": kind for kind in (*_EVENTS, "missed")}
_NOT_DONE = ("drop", "change", "publish", "call")
_SENT = {"publish": "sends", "call": "calls"}
KINDS = tuple(_EVENTS)
_LEVELS = {"WARN": Severity.WARNING, "ERROR": Severity.WARNING, "FATAL": Severity.ALARM}


@dataclass(frozen=True, slots=True)
class MonitorRecords:
    """Makes the records and counts; each callback in `told` gets every event.

    A change by several monitors counts for each in `counts`, and once for its topic in `at`. `keep(text)` stores the
    stops that go on, for `start`. `tick` must be called once a second while there is `some` action that goes on.
    """

    trail: AuditTrail
    fields: Callable[[str, bytes], dict[str, object] | None]
    told: list[Callable[[MonitorEvent], None]]
    keep: Callable[[str], None] = lambda _stops: None
    repetitions: Repetitions = field(default_factory=Repetitions, init=False)
    stops: Stops = field(init=False)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter, init=False)
    at: Counter[tuple[str, str]] = field(default_factory=Counter, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stops", Stops(lambda stops: self.keep(msgspec.json.encode(stops).decode())))

    def start(self, kept: str) -> None:
        """Close the stops that went on when control ended: when they ended is not known."""
        for stop in msgspec.json.decode(kept, type=list[StoppedTopic]):
            text = f"{stop.monitor} stopped {stop.topic}, and its end is not known, because control ended before it"
            self._say_ended(stop, text, unknown_end=True)
        self.keep("[]")

    @property
    def some(self) -> bool:
        return self.stops.some or self.repetitions.some

    def tick(self) -> None:
        now = clock.now()
        for event, whole in self.repetitions.pop_ended(now):
            self._record(event, whole)
        for stop in self.stops.pop_ended(now):
            seconds = (stop.until - stop.since) / 1e9
            text = f"{stop.monitor} stopped {stop.topic} for {seconds:.1f} s, {counted(stop.count, 'time')}"
            self._say_ended(stop, f"{text}: {stop.cause}" if stop.cause else text, seconds=round(seconds, 3))

    def _say_ended(self, stop: StoppedTopic, text: str, **more: Any) -> None:
        since, until = stop.span
        self.trail.happened(
            "stop ended",
            text,
            host=stop.host or None,
            caller_id=stop.node or None,
            category="monitor",
            resource=stop.topic,
            monitor=stop.monitor,
            since=moment(since),
            until=moment(until),
            actions=stop.count,
            begun_in=stop.record,
            more={"cause": stop.cause, **more} if stop.cause else more,
        )

    def reported(self, events: list[MonitorEvent], lost: int, ahead: int) -> None:
        for event in events:
            for monitor in _monitors(event):
                self.counts[event.kind, monitor] += event.count or 1
                if event.kind == "drop":
                    self.trail.meter.dropped.add(monitor, event.count or 1)
            if event.kind in ("drop", "change"):
                self.at[event.kind, event.resource] += event.count or 1
            self._take(event, ahead)
            for tell in tuple(self.told):  # one may remove itself
                tell(event)
        if lost:
            text = (
                f"{counted(lost, 'report of a monitor was', 'reports of monitors were')} lost while control"
                " was not running"
            )
            self.trail.happened("records lost", text, lost=lost)

    def _take(self, event: MonitorEvent, ahead: int) -> None:
        now = clock.now()
        if not event.safe:
            event_now = self.repetitions.take(event, now)
            if event_now is not None:
                self._record(event_now)
            return
        stop = self.stops.take(event, now, ahead)
        if stop is not None:
            cause = stop.cause or "its conditions are in the record"
            begun = msgspec.structs.replace(event, text=f"{stop.monitor} stops {stop.topic}: {cause}")
            self.stops.note_record(stop, self._record(begun))

    def _record(self, event: MonitorEvent, whole: Mapping[str, float] = MappingProxyType({})) -> str:
        name, severity = _STOP if event.safe else _EVENTS.get(event.kind, ("monitor log", Severity.INFO))
        detail: dict[str, Any] = {"monitor": event.monitor}
        shadowed = _SHADOW_KINDS.get(event.kind)
        if shadowed is not None:
            name, severity = "shadow observed", Severity.INFO
            detail |= {"shadow": True, "would": shadowed}
        detail["happened"] = moment(event.time)
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
        if event.first:
            detail |= {"first_time": event.first, "last_time": event.time}
        if event.count:
            detail |= {"count": event.count, **whole}
            text = _number(event, whole) + (f": {text}" if text else "")
        if shadowed is not None:
            text = f"in shadow mode, not done: {text}" if shadowed in _NOT_DONE else f"in shadow mode: {text}"
        return self.trail.happened(
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


def moment(time_ns: int) -> str:
    return datetime.datetime.fromtimestamp(time_ns / 1e9, datetime.UTC).isoformat()


def _number(event: MonitorEvent, whole: Mapping[str, float]) -> str:
    if whole:
        return f"{event.count} more, {whole['total']} in {whole['seconds']:.0f} s, until it ended"
    length = event.time - (event.first or event.time)
    if length <= _SECOND:
        return f"{event.count} more in the same second"
    return f"{event.count} more in {length / _SECOND:.0f} s"


def _monitors(event: MonitorEvent) -> set[str]:
    match event.detail.get("changed_by"):
        case [*together]:
            return {event.monitor, *(str(other).partition(".")[0] for other in together)}
    return {event.monitor}
