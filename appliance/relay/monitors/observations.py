"""Report monitors' actions to the control process: the first event of each kind in a second in full, the others as
counts.

Invariants:
- For each monitor, kind and distinction (the category of a verdict, the text of a log line), one event a second is
  reported in full. The others of that second become one event with a count, whose detail holds what they have in
  common. Counts are complete.
- Each full report gives the sender of the message (caller id and host), and the message's number in its publication.
- The number of distinctions is bounded (`_DISTINCT`); beyond it, events are counted under the kind alone.
- Counters are sent after the events that they count. Once a second, counters without a reported event are sent as well.
- Without a link to the control process, at most `_KEPT` events wait; only the number of further events is reported.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

from appliance.channel.messages import MonitorEvent, MonitorRow, MonitorsCounted, MonitorsReported
from appliance.relay.loop import EventLoop, LoopTimer
from appliance.relay.monitors.observation_points import ObservationPoint, ObservedMessage
from appliance.relay.report import Reporter

SHOWN = 1024
"""The most bytes reported of a message, before and after a change."""

_TEXT = 4096
_DISTINCT = 100
_KEPT = 10_000
_AT_ONCE = 200  # events in one message
_FLUSH_SECONDS = 0.05
_VALUES = 32
_INTEGERS = range(-(1 << 63), 1 << 64)

_NOTHING: Mapping[str, Any] = MappingProxyType({})

_Key = tuple[str, str, str, str, str, str]
"""Kind, monitor, key of the incarnation, resource, host, distinction: clients of one host are counted together."""


class Observations:
    """The events of monitors, sent in batches; `rows()` returns the counters of all monitors."""

    def __init__(self, loop: EventLoop, reporter: Reporter, rows: Callable[[], Iterable[MonitorRow]]) -> None:
        self._loop = loop
        self._reporter = reporter
        self._rows = rows
        self._told: dict[_Key, int] = {}
        self._distinct: dict[tuple[str, str], int] = {}
        self._callers: dict[_Key, str] = {}
        self._last: dict[_Key, int] = {}
        self._shared: dict[_Key, Mapping[str, Any]] = {}
        self._waiting: deque[MonitorEvent] = deque()
        self._lost = 0
        self._timer: LoopTimer | None = None
        self._counted: list[MonitorRow] = []

    def note(
        self,
        kind: str,
        monitor: str,
        point: ObservationPoint,
        time: int,
        text: str,
        *,
        distinction: str = "",
        shared: Mapping[str, Any] = _NOTHING,
        detail: Mapping[str, Any] | None = None,
        before: bytes = b"",
        after: bytes = b"",
        size: int = 0,
        observed: ObservedMessage | None = None,
    ) -> None:
        """Note an event at `point`, concerning the `observed` message.

        `shared` is the detail for the count of further events with this distinction.
        """
        text = text[:_TEXT]
        key = self._known(kind, monitor, point, distinction, shared)
        self._said(key, point)
        if key in self._told:
            self._told[key] += 1
            self._last[key] = time
            return
        self._told[key] = 0
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
        distinction: str = "",
        shared: Mapping[str, Any] = _NOTHING,
    ) -> None:
        """Add `count` events, the last of them at this time, and report only their number."""
        key = self._known(kind, monitor, point, distinction, shared)
        self._said(key, point)
        self._told[key] = self._told.get(key, 0) + count
        self._last[key] = max(time, self._last.get(key, 0))

    def was_reported(self, kind: str, monitor: str, point: ObservationPoint, distinction: str = "") -> bool:
        """Whether such an event was already reported in this second, so the next one is only counted."""
        return self._key(kind, monitor, point, distinction) in self._told

    def tick(self) -> None:
        """Send the counts of this second, and the state of the monitors if it changed."""
        for key, count in self._told.items():
            if count:
                self._add(self._count_of(key, count))
        self._told.clear()
        self._callers.clear()
        self._last.clear()
        self._shared.clear()
        self._distinct.clear()
        self.tell_counters()

    def repeat(self) -> None:
        """Send all waiting events, and all counters, to a new control."""
        self._counted = []
        self.flush()

    def _count_of(self, key: _Key, count: int) -> MonitorEvent:
        kind, monitor, owner, resource, host, distinction = key
        return MonitorEvent(
            kind,
            monitor,
            owner,
            resource,
            self._last[key],
            distinction,
            _plain(self._shared.get(key, _NOTHING)),
            count=count,
            host=host,
            caller_id=self._callers[key],
        )

    def _said(self, key: _Key, point: ObservationPoint) -> None:
        """Note the sender; a count for several clients of a host names none of them."""
        if self._callers.setdefault(key, point.caller_id) != point.caller_id:
            self._callers[key] = ""

    def _key(self, kind: str, monitor: str, point: ObservationPoint, distinction: str) -> _Key:
        key = (kind, monitor, *point[:3], distinction[:_TEXT])
        beyond = key not in self._told and self._distinct.get((kind, monitor), 0) >= _DISTINCT
        return (kind, monitor, *point[:3], "") if beyond else key

    def _known(
        self, kind: str, monitor: str, point: ObservationPoint, distinction: str, shared: Mapping[str, Any]
    ) -> _Key:
        """Return the key, and count it among the distinctions."""
        key = self._key(kind, monitor, point, distinction)
        if key[-1] and key not in self._told:
            self._distinct[kind, monitor] = self._distinct.get((kind, monitor), 0) + 1
            if shared:
                self._shared[key] = shared
        return key

    def _add(self, event: MonitorEvent) -> None:
        if len(self._waiting) >= _KEPT:
            self._lost += 1
            return
        self._waiting.append(event)
        if self._timer is None:
            self._timer = self._loop.after(_FLUSH_SECONDS, self.flush)

    def flush(self) -> None:
        """Send waiting events to control, then the counters."""
        self._timer = None
        while self._reporter.attached and self._waiting:
            events = [self._waiting.popleft() for _ in range(min(_AT_ONCE, len(self._waiting)))]
            self._reporter.send(MonitorsReported(events, self._lost))
            self._lost = 0
        self.tell_counters()  # so that a reported drop is also counted

    def tell_counters(self) -> None:
        """Send the counters that have changed."""
        if not self._reporter.attached:
            return
        rows = list(self._rows())
        if rows != self._counted:
            self._counted = rows
            self._reporter.send(MonitorsCounted(rows))


def _plain(detail: Mapping[str, Any]) -> dict[str, Any]:
    """Return the detail with its values converted and bounded, so that a link can carry them."""
    return {str(name)[:200]: _value(value, 3) for name, value in list(detail.items())[:_VALUES]}


def _value(value: Any, depth: int) -> Any:
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and value in _INTEGERS):
        return value
    if isinstance(value, Mapping) and depth:
        return {str(name)[:200]: _value(item, depth - 1) for name, item in list(value.items())[:_VALUES]}
    if isinstance(value, list | tuple) and depth:
        return [_value(item, depth - 1) for item in value[:_VALUES]]
    if isinstance(value, bytes | bytearray):
        value = value[:200].decode("utf-8", "backslashreplace")
    return str(value)[:200]
