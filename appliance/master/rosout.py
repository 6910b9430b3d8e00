"""What monitors say, on `/rosout`: lines of output, verdicts and faults as `rosgraph_msgs/Log`, if it is configured.

Robot people look there (`rostopic echo /rosout_agg`, rqt_console). The audit log has everything; here come the first of
each kind and second with its text, as the relay tells them, and no more than `_A_SECOND` in a second: how many more
there were is said. As with a node's own logger, DEBUG is left out.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from appliance.channel.messages import MonitorEvent, OwnHeaderStated, OwnPublished
from roswire.definitions import Definitions
from roswire.log_message import DEBUG, ERROR, FATAL, INFO, TYPE, WARN, log_message

TOPIC = "/rosout"
_A_SECOND = 50
_LEVELS = {"DEBUG": DEBUG, "INFO": INFO, "WARN": WARN, "ERROR": ERROR, "FATAL": FATAL}
_ALARMING = frozenset({"violation", "fail", "timeout"})  # categories of verdicts


@dataclass(slots=True)
class Rosout:
    """Puts reports of monitors on `/rosout` in the name of `node`; `publish(message)` sends one.

    `file_of(monitor)` is the file of its specification.
    """

    node: str
    publish: Callable[[OwnPublished], None]
    file_of: Callable[[str], str]
    clock: Callable[[], float] = time.monotonic
    _sequence: int = 0
    _second: int = 0
    _told: int = 0
    _left_out: int = 0

    def reported(self, event: MonitorEvent) -> None:
        """A monitor did something; what is not output, a verdict or a fault is left to the audit log."""
        level, text = _words(event)
        if level < INFO:
            return
        second = int(self.clock())
        if second != self._second:
            left, self._second, self._told, self._left_out = self._left_out, second, 0, 0
            if left:
                self._say(event.time, WARN, f"{left} more lines of monitors; the audit log has them", "")
        if self._told >= _A_SECOND:
            self._left_out += event.count or 1
            return
        self._told += 1
        self._say(event.time, level, text, event.monitor)

    def _say(self, time_ns: int, level: int, text: str, monitor: str) -> None:
        self._sequence += 1
        data = log_message(
            self._sequence, time_ns, level, self.node, text, file=self.file_of(monitor), function=monitor
        )
        self.publish(OwnPublished(TOPIC, data))


def header(definitions: Definitions) -> OwnHeaderStated:
    """What the relay needs to know to serve the topic."""
    return OwnHeaderStated(TOPIC, TYPE, definitions.md5sum(TYPE), definitions.full_text(TYPE))


def _words(event: MonitorEvent) -> tuple[int, str]:
    """The level of a report and its text; level 0 of one that is not for `/rosout`.

    Of those that are told as a count, level or category stand in the text.
    """
    text, level, category = event.text, event.detail.get("level"), event.detail.get("category")
    if event.count and event.kind == "log":
        level, _, text = text.partition(" ")
    elif event.count:
        category = text.rpartition(" ")[2]
    if event.count:
        text = f"{event.count} more in the same second: {text}"
    if event.kind == "log":
        return _LEVELS.get(str(level), INFO), text
    if event.kind == "fault":
        return ERROR, text
    if event.kind == "verdict":
        return (WARN if category in _ALARMING else INFO), text
    return 0, text
