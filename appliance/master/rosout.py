"""Publish reports of monitors on `/rosout`, if configured.

At most `_A_SECOND` reports are published per second, with the number of omitted ones. As in a node's own logger,
DEBUG is omitted.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.messages import MonitorEvent, OwnHeaderStated, OwnPublished
from roswire.definitions import Definitions
from roswire.log_message import DEBUG, ERROR, FATAL, INFO, TYPE, WARN, log_message

TOPIC = "/rosout"
_A_SECOND = 50
_LEVELS = {"DEBUG": DEBUG, "INFO": INFO, "WARN": WARN, "ERROR": ERROR, "FATAL": FATAL}
_ALARMING = frozenset({"violation", "fail", "timeout"})  # categories of verdicts with level WARN


@dataclass(slots=True)
class Rosout:
    """Publishes reports of monitors in the name of `node`."""

    node: str
    publish: Callable[[OwnPublished], None]
    file_of: Callable[[str], str]
    clock: Callable[[], float] = clock.now
    _sequence: int = 0
    _second: int = 0
    _published: int = 0
    _left_out: int = 0

    def reported(self, event: MonitorEvent) -> None:
        level, text = _words(event)
        if level < INFO:
            return
        second = int(self.clock())
        if second != self._second:
            left, self._second, self._published, self._left_out = self._left_out, second, 0, 0
            if left:
                self._publish_line(
                    event.time, WARN, f"{counted(left, 'more line')} of monitors; the audit log has them", ""
                )
        if self._published >= _A_SECOND:
            self._left_out += event.count or 1
            return
        self._published += 1
        self._publish_line(event.time, level, text, event.monitor)

    def _publish_line(self, time_ns: int, level: int, text: str, monitor: str) -> None:
        self._sequence += 1
        data = log_message(
            self._sequence, time_ns, level, self.node, text, file=self.file_of(monitor), function=monitor
        )
        self.publish(OwnPublished(TOPIC, data))


def header(definitions: Definitions) -> OwnHeaderStated:
    return OwnHeaderStated(TOPIC, TYPE, definitions.md5sum(TYPE), definitions.full_text(TYPE))


def _words(event: MonitorEvent) -> tuple[int, str]:
    text, level, category = event.text, event.detail.get("level"), event.detail.get("category")
    if event.count:
        text = f"{event.count} more in the same second" + (f": {text}" if text else "")
    if event.kind == "log":
        return _LEVELS.get(str(level), INFO), text
    if event.kind == "fault":
        return ERROR, text
    if event.kind == "verdict":
        return (WARN if category in _ALARMING else INFO), text
    return 0, text
