"""What monitors say, on `/rosout`: lines of output, verdicts and faults as `rosgraph_msgs/Log`, if it is configured.

Robot people look there (`rostopic echo /rosout_agg`, rqt_console). The audit log has everything; here come the first of
each kind and second with its text, as the relay tells them, and no more than `_A_SECOND` in a second: how many more
there were is said. As with a node's own logger, DEBUG is left out.
"""

import struct
import time
from collections.abc import Callable

from appliance.channel.messages import MonitorEvent, OwnHeaderStated, OwnPublished
from appliance.ros.definitions import Definitions

TOPIC = "/rosout"
TYPE = "rosgraph_msgs/Log"
_A_SECOND = 50
_INFO, _WARN, _ERROR = 2, 4, 8
_LEVELS = {"DEBUG": 1, "INFO": _INFO, "WARN": _WARN, "ERROR": _ERROR, "FATAL": 16}
_ALARMING = frozenset({"violation", "fail", "timeout"})  # categories of verdicts
_HEADER = struct.Struct("<III")
_LENGTH = struct.Struct("<I")


class Rosout:
    """Puts reports of monitors on `/rosout` in the name of `node`; `publish(message)` sends one.

    `file_of(monitor)` is the file of its specification.
    """

    def __init__(
        self,
        node: str,
        publish: Callable[[OwnPublished], None],
        file_of: Callable[[str], str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._publish = publish
        self._file_of = file_of
        self._clock = clock
        self._sequence = 0
        self._second = 0
        self._told = 0
        self._left_out = 0

    def reported(self, event: MonitorEvent) -> None:
        """A monitor did something; what is not output, a verdict or a fault is left to the audit log."""
        level, text = _words(event)
        if level < _INFO:
            return
        second = int(self._clock())
        if second != self._second:
            left, self._second, self._told, self._left_out = self._left_out, second, 0, 0
            if left:
                self._say(event.time, _WARN, f"{left} more lines of monitors; the audit log has them", "")
        if self._told >= _A_SECOND:
            self._left_out += event.count or 1
            return
        self._told += 1
        self._say(event.time, level, text, event.monitor)

    def _say(self, time_ns: int, level: int, text: str, monitor: str) -> None:
        self._sequence += 1
        data = log_message(
            self._sequence, time_ns, level, self._node, text, file=self._file_of(monitor), function=monitor
        )
        self._publish(OwnPublished(TOPIC, data))


def header(definitions: Definitions) -> OwnHeaderStated:
    """What the relay needs to know to serve the topic."""
    return OwnHeaderStated(TOPIC, TYPE, definitions.md5sum(TYPE), definitions.full_text(TYPE))


def log_message(
    sequence: int, time_ns: int, level: int, name: str, text: str, *, file: str, function: str
) -> bytes:
    """A `rosgraph_msgs/Log` as its bytes on the wire; `time_ns` is since the epoch, `level` as in its definition."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    fields = (name, text, file, function)
    return b"".join((
        _HEADER.pack(sequence & 0xFFFFFFFF, seconds & 0xFFFFFFFF, nanoseconds),
        _string(""),
        bytes([level]),
        *map(_string, fields),
        _LENGTH.pack(0),  # line
        _LENGTH.pack(0),  # topics: how many
    ))  # fmt: skip


def _string(text: str) -> bytes:
    data = text.encode("utf-8", "replace")
    return _LENGTH.pack(len(data)) + data


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
        return _LEVELS.get(str(level), _INFO), text
    if event.kind == "fault":
        return _ERROR, text
    if event.kind == "verdict":
        return (_WARN if category in _ALARMING else _INFO), text
    return 0, text
