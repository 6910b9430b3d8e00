"""Report monitors' actions to control: the first event of each kind in a second in full, the others as counts.

- Counts are complete for each monitor, kind and distinction (the category of a verdict, the text of a log line
  without its numbers), but at most `_DISTINCT` distinctions are separate.
- A count has the last text, if the texts differ at most in numbers.
- Counters are sent after the events that they count.
- Without a link to control, at most `_KEPT` events wait; of the rest, only the number is reported.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from appliance.base.varying_numbers import without_numbers
from appliance.channel.messages import MonitorEvent, MonitorRow, MonitorsCounted, MonitorsReported
from appliance.relay.loop import EventLoop, LoopTimer
from appliance.relay.monitors.observation_points import ObservationPoint, ObservedMessage
from appliance.relay.report import Reporter

SHOWN = 1024
"""The most bytes reported of a message, before and after a change."""

LONGEST_TEXT = 4096

_DISTINCT = 100
_KEPT = 10_000
_AT_ONCE = 200  # events in one message
_FLUSH_SECONDS = 0.05
_VALUES = 32
_INTEGERS = range(-(1 << 63), 1 << 64)

_NOTHING: Mapping[str, object] = MappingProxyType({})

_Key = tuple[str, str, str, str, str, str, bool]
"""Kind, monitor, key of the incarnation, resource, host, distinction, and whether the monitor stops the topic.

Clients of one host are counted together.
"""


@dataclass(slots=True)
class _Repeated:
    """The events of a key in this second since the first one, with what they have in common.

    `first_time` is 0 if it is unknown. `caller_id` is empty if there were several callers.
    """

    caller_id: str
    shared: Mapping[str, object]
    count: int = 0
    first_time: int = 0
    last_time: int = 0
    first_text: str = ""
    last_text: str = ""
    alike: bool = True

    def add(self, count: int, first_time: int, last_time: int, text: str) -> None:
        if not self.count:
            self.first_time, self.first_text = first_time, text
        else:
            self.first_time = min(self.first_time, first_time)
            self.alike = self.alike and (
                text == self.last_text or without_numbers(text) == without_numbers(self.last_text)
            )
        self.count += count
        self.last_time, self.last_text = max(last_time, self.last_time), text

    def detail(self) -> dict[str, object]:
        found = dict(self.shared)
        if self.alike and self.first_text != self.last_text:
            found |= {"first_text": self.first_text, "last_text": self.last_text}
        return found


class Observations:
    """The events of monitors, sent in batches.

    `rows()` returns the counters of all monitors, and `ahead()` how far the system clock is ahead of that of monitors.
    """

    def __init__(
        self,
        loop: EventLoop,
        reporter: Reporter,
        rows: Callable[[], Iterable[MonitorRow]],
        ahead: Callable[[], int] = lambda: 0,
    ) -> None:
        self.unfit, self.acting = "", 0
        """Why this relay's part of the heartbeat is off."""
        self._loop = loop
        self._reporter = reporter
        self._rows = rows
        self._ahead = ahead
        self._told: dict[_Key, _Repeated] = {}
        self._distinct: dict[tuple[str, str], int] = {}
        self._waiting: deque[MonitorEvent] = deque()
        self._lost = 0
        self._timer: LoopTimer | None = None
        self._counted: MonitorsCounted | None = None

    def note(
        self,
        kind: str,
        monitor: str,
        point: ObservationPoint,
        time: int,
        text: str,
        *,
        distinction: str = "",
        safe: bool = False,
        only_number: bool = False,
        shared: Mapping[str, object] = _NOTHING,
        detail: Mapping[str, object] | None = None,
        before: bytes = b"",
        after: bytes = b"",
        size: int = 0,
        observed: ObservedMessage | None = None,
    ) -> None:
        """Report an event about the `observed` message, or count it if its kind was already reported in this second.

        `shared` is the detail of the count; with `only_number`, the count has no text. `safe`: the monitor sent its
        safe message, or put it in the place of the message.
        """
        text = text[:LONGEST_TEXT]
        repeated = self._repeated(kind, monitor, point, distinction, safe=safe)
        if repeated is not None:
            repeated.add(1, time, time, "" if only_number else text)
            return
        self._begin(kind, monitor, point, distinction, shared, safe=safe)
        plain = _plain({**(detail or {}), **(observed.detail() if observed is not None else {})})
        self._add(
            MonitorEvent(
                kind,
                monitor,
                point.key,
                point.resource,
                time,
                text,
                plain,
                before,
                after,
                size,
                host=point.host,
                caller_id=point.caller_id,
                safe=safe,
            )
        )

    def add(
        self,
        kind: str,
        monitor: str,
        point: ObservationPoint,
        time: int,
        count: int,
        *,
        text: str = "",
        first: int = 0,
        distinction: str = "",
        shared: Mapping[str, object] = _NOTHING,
        safe: bool = False,
    ) -> None:
        repeated = self._repeated(kind, monitor, point, distinction, safe=safe)
        if repeated is None:
            repeated = self._begin(kind, monitor, point, distinction, shared, safe=safe)
        repeated.add(count, first, time, text)

    def was_reported(self, kind: str, monitor: str, point: ObservationPoint, distinction: str = "") -> bool:
        return self._key(kind, monitor, point, distinction, safe=False) in self._told

    @property
    def some(self) -> bool:
        return bool(self._told)

    def tick(self) -> None:
        for key, repeated in self._told.items():
            if repeated.count:
                self._add(_count_of(key, repeated))
        self._told.clear()
        self._distinct.clear()
        self.tell_counters()

    def repeat(self) -> None:
        self._counted = None
        self.flush()

    def _key(self, kind: str, monitor: str, point: ObservationPoint, distinction: str, *, safe: bool) -> _Key:
        key = (kind, monitor, *point[:3], distinction[:LONGEST_TEXT], safe)
        beyond = key not in self._told and self._distinct.get((kind, monitor), 0) >= _DISTINCT
        return (kind, monitor, *point[:3], "", safe) if beyond else key

    def _repeated(
        self, kind: str, monitor: str, point: ObservationPoint, distinction: str, *, safe: bool
    ) -> _Repeated | None:
        repeated = self._told.get(self._key(kind, monitor, point, distinction, safe=safe))
        if repeated is not None and repeated.caller_id != point.caller_id:
            repeated.caller_id = ""
        return repeated

    def _begin(
        self,
        kind: str,
        monitor: str,
        point: ObservationPoint,
        distinction: str,
        shared: Mapping[str, object],
        *,
        safe: bool,
    ) -> _Repeated:
        key = self._key(kind, monitor, point, distinction, safe=safe)
        if key[-2]:
            self._distinct[kind, monitor] = self._distinct.get((kind, monitor), 0) + 1
        self._told[key] = _Repeated(point.caller_id, shared if key[-2] else _NOTHING)
        return self._told[key]

    def _add(self, event: MonitorEvent) -> None:
        if len(self._waiting) >= _KEPT:
            self._lost += 1
            return
        self._waiting.append(event)
        if self._timer is None:
            self._timer = self._loop.after(_FLUSH_SECONDS, self.flush)

    def flush(self) -> None:
        self._timer = None
        while self._reporter.attached and self._waiting:
            events = [self._waiting.popleft() for _ in range(min(_AT_ONCE, len(self._waiting)))]
            self._reporter.send(MonitorsReported(events, self._lost, self._ahead()))
            self._lost = 0
        self.tell_counters()  # so that a reported drop is also counted

    def tell_counters(self) -> None:
        if not self._reporter.attached:
            return
        counted = MonitorsCounted(list(self._rows()), self.unfit, self.acting)
        if counted != self._counted:
            self._counted = counted
            self._reporter.send(counted)


def _count_of(key: _Key, repeated: _Repeated) -> MonitorEvent:
    kind, monitor, owner, resource, host, _distinction, safe = key
    return MonitorEvent(
        kind,
        monitor,
        owner,
        resource,
        repeated.last_time,
        repeated.last_text if repeated.alike else "",
        _plain(repeated.detail()),
        count=repeated.count,
        host=host,
        caller_id=repeated.caller_id,
        safe=safe,
        first=repeated.first_time,
    )


def _plain(detail: Mapping[str, object]) -> dict[str, object]:
    return {str(name)[:200]: _value(value, 3) for name, value in list(detail.items())[:_VALUES]}


def _value(value: object, depth: int) -> object:
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and value in _INTEGERS):
        return value
    if isinstance(value, Mapping) and depth:
        return {str(name)[:200]: _value(item, depth - 1) for name, item in list(value.items())[:_VALUES]}
    if isinstance(value, list | tuple) and depth:
        return [_value(item, depth - 1) for item in value[:_VALUES]]
    if isinstance(value, bytes | bytearray):
        value = value[:200].decode("utf-8", "backslashreplace")
    return str(value)[:200]
