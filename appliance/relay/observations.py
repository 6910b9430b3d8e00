"""What the relay tells control about monitors: the first of each kind and second in full, the rest counted.

Invariants:
- Of each monitor, kind and distinction (the category of a verdict, the text of a log line) one event a second is
  told in full; the others of that second are one event with a count, whose detail is what they share. Nothing that
  happened is left out of the counts.
- Distinctions are bounded (`_DISTINCT`); beyond, what happens is counted under the kind alone.
- Counters follow the events that they count, and once a second those of which no event was told.
- While there is no control, at most `_KEPT` events wait; how many more there were is said.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

from appliance.channel.messages import MonitorEvent, MonitorRow, MonitorsCounted, MonitorsReported
from appliance.relay.loop import Loop, Timer
from appliance.relay.report import Reporter

SHOWN = 1024
"""Bytes of a message that are told, before and after."""

_TEXT = 4096
_DISTINCT = 100
_KEPT = 10_000
_AT_ONCE = 200  # events in one message
_FLUSH_SECONDS = 0.05
_VALUES = 32
_INTEGERS = range(-(1 << 63), 1 << 64)

_NOTHING: Mapping[str, Any] = MappingProxyType({})

_Key = tuple[str, str, str, str, str]


class Observations:
    """Collects events of monitors and sends them in batches; `rows()` gives the counters of all monitors."""

    def __init__(self, loop: Loop, reporter: Reporter, rows: Callable[[], Iterable[MonitorRow]]) -> None:
        self._loop = loop
        self._reporter = reporter
        self._rows = rows
        self._told: dict[_Key, int] = {}
        self._distinct: dict[tuple[str, str], int] = {}
        self._last: dict[_Key, int] = {}
        self._shared: dict[_Key, Mapping[str, Any]] = {}
        self._waiting: deque[MonitorEvent] = deque()
        self._lost = 0
        self._timer: Timer | None = None
        self._counted: list[MonitorRow] = []

    def note(
        self,
        kind: str,
        monitor: str,
        place: tuple[str, str],
        time: int,
        text: str,
        *,
        distinction: str = "",
        shared: Mapping[str, Any] = _NOTHING,
        detail: Mapping[str, Any] | None = None,
        before: bytes = b"",
        after: bytes = b"",
        size: int = 0,
    ) -> None:
        """Something happened at `place` (key of the incarnation, topic or service).

        `shared` is the detail of the count of all that have this distinction.
        """
        text = text[:_TEXT]
        key = self._key(kind, monitor, place, distinction, shared)
        if key in self._told:
            self._told[key] += 1
            self._last[key] = time
            return
        self._told[key] = 0
        self._add(
            MonitorEvent(
                kind, monitor, place[0], place[1], time, text, _plain(detail or {}), before, after, size
            )
        )

    def add(
        self,
        kind: str,
        monitor: str,
        place: tuple[str, str],
        time: int,
        count: int,
        *,
        distinction: str = "",
        shared: Mapping[str, Any] = _NOTHING,
    ) -> None:
        """So many more happened at `place`, the last at this time; they are told as a count."""
        key = self._key(kind, monitor, place, distinction, shared)
        self._told[key] = self._told.get(key, 0) + count
        self._last[key] = max(time, self._last.get(key, 0))

    def told(self, kind: str, monitor: str, place: tuple[str, str]) -> bool:
        """Whether this has been told in this second, so that the next is only counted."""
        return (kind, monitor, *place, "") in self._told

    def tick(self) -> None:
        """A second is over: tell the counts, and the state of the monitors if it changed."""
        for key, count in self._told.items():
            if count:
                kind, monitor, owner, resource, distinction = key
                shared = _plain(self._shared.get(key, _NOTHING))
                self._add(
                    MonitorEvent(
                        kind, monitor, owner, resource, self._last[key], distinction, shared, count=count
                    )
                )
        self._told.clear()
        self._last.clear()
        self._shared.clear()
        self._distinct.clear()
        self._tell_counters()

    def repeat(self) -> None:
        """There is a new control: it is told everything that waits, and all counters."""
        self._counted = []
        self._flush()

    def _key(
        self, kind: str, monitor: str, place: tuple[str, str], distinction: str, shared: Mapping[str, Any]
    ) -> _Key:
        key = (kind, monitor, *place, distinction[:_TEXT])
        if key in self._told or not distinction:
            return key
        known = self._distinct.get((kind, monitor), 0)
        if known >= _DISTINCT:
            return (kind, monitor, *place, "")
        self._distinct[kind, monitor] = known + 1
        if shared:
            self._shared[key] = shared
        return key

    def _add(self, event: MonitorEvent) -> None:
        if len(self._waiting) >= _KEPT:
            self._lost += 1
            return
        self._waiting.append(event)
        if self._timer is None:
            self._timer = self._loop.after(_FLUSH_SECONDS, self._flush)

    def _flush(self) -> None:
        self._timer = None
        while self._reporter.attached and self._waiting:
            events = [self._waiting.popleft() for _ in range(min(_AT_ONCE, len(self._waiting)))]
            self._reporter.send(MonitorsReported(events, self._lost))
            self._lost = 0
        self._tell_counters()  # who reads of a drop finds it counted

    def _tell_counters(self) -> None:
        if not self._reporter.attached:
            return
        rows = list(self._rows())
        if rows != self._counted:
            self._counted = rows
            self._reporter.send(MonitorsCounted(rows))


def _plain(detail: Mapping[str, Any]) -> dict[str, Any]:
    """The detail as values that a link carries, each bounded."""
    return {str(name)[:200]: _value(value, 3) for name, value in list(detail.items())[:_VALUES]}


def _value(value: Any, depth: int) -> Any:
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and value in _INTEGERS):
        return value
    if isinstance(value, Mapping) and depth:
        return {str(name)[:200]: _value(one, depth - 1) for name, one in list(value.items())[:_VALUES]}
    if isinstance(value, list | tuple) and depth:
        return [_value(one, depth - 1) for one in value[:_VALUES]]
    if isinstance(value, bytes | bytearray):
        value = value[:200].decode("utf-8", "backslashreplace")
    return str(value)[:200]
