"""Make audit records and counts from the relays' reports about monitors."""

import datetime
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.messages import MonitorEvent
from appliance.specifications.episodes import Repetitions, StoppedTopic, Stops
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
        for event in self.repetitions.ended(now):
            self._record(event)
        for stop in self.stops.ended(now):
            seconds = (stop.until - stop.since) / 1e9
            text = f"{stop.monitor} stopped {stop.topic} for {seconds:.1f} s, {counted(stop.count, 'time')}"
            self._say_ended(stop, f"{text}: {stop.cause}" if stop.cause else text, seconds=round(seconds, 3))

    def _say_ended(self, stop: StoppedTopic, text: str, **more: Any) -> None:
        self.trail.happened(
            "stop ended",
            text,
            host=stop.host or None,
            caller_id=stop.node or None,
            category="monitor",
            resource=stop.topic,
            monitor=stop.monitor,
            since=moment(stop.since),
            until=moment(stop.until),
            actions=stop.count,
            begun_in=stop.record,
            more={"cause": stop.cause, **more} if stop.cause else more,
        )

    def reported(self, events: list[MonitorEvent], lost: int) -> None:
        for event in events:
            for monitor in _monitors(event):
                self.counts[event.kind, monitor] += event.count or 1
                if event.kind == "drop":
                    self.trail.meter.dropped.add(monitor, event.count or 1)
            if event.kind in ("drop", "change"):
                self.at[event.kind, event.resource] += event.count or 1
            self._take(event)
            for tell in tuple(self.told):  # one may remove itself
                tell(event)
        if lost:
            text = (
                f"{counted(lost, 'report of a monitor was', 'reports of monitors were')} lost while control"
                " was not running"
            )
            self.trail.happened("records lost", text, lost=lost)

    def _take(self, event: MonitorEvent) -> None:
        now = clock.now()
        if not event.safe:
            event_now = self.repetitions.take(event, now)
            if event_now is not None:
                self._record(event_now)
            return
        stop = self.stops.take(event, now)
        if stop is not None:
            cause = stop.cause or "its conditions are in the record"
            begun = msgspec.structs.replace(event, text=f"{stop.monitor} stops {stop.topic}: {cause}")
            self.stops.recorded(stop, self._record(begun))

    def _record(self, event: MonitorEvent) -> str:
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
        if event.count:
            detail["count"] = event.count
            text = _number(event) + (f": {text}" if text else "")
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


def _number(event: MonitorEvent) -> str:
    detail = event.detail
    if "seconds" in detail:
        return f"{event.count} more, {detail['total']} in {detail['seconds']:.0f} s, until it ended"
    first, last = int(detail.get("first_time", 0)), int(detail.get("last_time", 0))
    if last - first <= _SECOND:
        return f"{event.count} more in the same second"
    return f"{event.count} more in {(last - first) / _SECOND:.0f} s"


def _monitors(event: MonitorEvent) -> set[str]:
    together = event.detail.get("changed_by", ())
    return {event.monitor, *(str(other).partition(".")[0] for other in together)}
