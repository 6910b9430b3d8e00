"""Publish the alarms and the guards' states on `/diagnostics`, for the robot's own safety node and rqt_robot_monitor.

Levels follow the table of alarm kinds, and texts are those of `rosrv status`. The first entry has the level of the
worst alarm; an alarm that ended has one last entry, whose level is OK.
"""

import asyncio
import contextlib
import struct
from collections.abc import Mapping
from typing import NamedTuple

from appliance.base import clock
from appliance.channel.alarms import activity, open_alarms
from appliance.channel.answers.status import Status
from appliance.channel.channel import ChannelFullError
from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.core import Alarms, RelayOrders
from appliance.features.views import states_of
from roswire.standard import standard_definitions

TOPIC = "/diagnostics"
_TYPE = "diagnostic_msgs/DiagnosticArray"
_LEVELS = {"alarm": b"\2", "warning": b"\1", "notice": b"\0"}  # ERROR, WARN, OK
_OK = b"\0"
_MAX_ALARMS = 50
_LONGEST = 500  # characters of a text
_LOOK_SECONDS = 0.5  # a look takes control 2 to 3 ms
_PERIOD_SECONDS = 1.0
_LENGTH = struct.Struct("<I")
_HEAD = struct.Struct("<IIII")  # seq, stamp, and the length of an empty frame


class Entry(NamedTuple):
    """A `diagnostic_msgs/DiagnosticStatus` without its name."""

    level: bytes
    message: str
    values: Mapping[str, str] = {}


def entries_of(status: Status) -> dict[str, Entry]:
    """Return the entries by name: all alarms in one, the guards in one, and the `_MAX_ALARMS` most severe alarms."""
    alarms = [*open_alarms(status), *activity(status)]
    alarms.sort(key=lambda alarm: _LEVELS[alarm.severity], reverse=True)
    worst = _LEVELS[alarms[0].severity] if alarms else _OK
    found = {"alarms": Entry(worst, alarms[0].text if alarms else "no alarms")}
    for view, state in states_of(status):
        if view.field == "guards" and view.line is not None:
            own = [alarm for alarm in alarms if alarm.kind.partition(":")[0] in view.kinds]
            level = max((_LEVELS[alarm.severity] for alarm in own), default=_OK)
            line = view.line(state)[1]
            found["guards"] = Entry(
                level, line if isinstance(line, str) else "".join(text for text, _ in line)
            )
    for alarm in alarms[:_MAX_ALARMS]:
        level, text = _LEVELS[alarm.severity], alarm.text
        values = {"severity": alarm.severity, "about": alarm.about}
        found[alarm.kind] = Entry(level, text, values | ({"handled": alarm.handled} if alarm.handled else {}))
    if len(alarms) > _MAX_ALARMS:
        found["alarms"] = found["alarms"]._replace(values={"left out": str(len(alarms) - _MAX_ALARMS)})
    return found


def encode_array(entries: Mapping[str, Entry], sequence: int, node: str, robot: str) -> bytes:
    seconds, nanoseconds = divmod(clock.wall_ns(), 1_000_000_000)
    parts = [
        entry.level
        + _string(f"{node}: {name}"[:_LONGEST])
        + _string(entry.message[:_LONGEST])
        + _string(robot)
        + _array([_string(key) + _string(value[:_LONGEST]) for key, value in entry.values.items()])
        for name, entry in entries.items()
    ]
    head = _HEAD.pack(sequence & 0xFFFFFFFF, seconds & 0xFFFFFFFF, nanoseconds, 0)
    return head + _array(parts)


class Diagnostics:
    """Publishes the entries once a second, and when a level changes or an entry comes or goes."""

    def __init__(self, alarms: Alarms, relay: RelayOrders, node: str) -> None:
        self._status, self._relay, self._node = alarms.status, relay, node.strip("/")
        self._told: dict[str, bytes] = {}  # the levels, by name
        self._told_at = float("-inf")
        self._sequence = 0
        definitions = standard_definitions()
        md5sum, text = definitions.md5sum(_TYPE), definitions.full_text(_TYPE)
        relay.publish_only("alarms", [OwnHeaderStated(TOPIC, _TYPE, md5sum, text)])

    async def run(self) -> None:
        while True:
            self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self) -> None:
        status = self._status()
        present = entries_of(status)
        ended = {name: Entry(_OK, "ended") for name in self._told.keys() - present.keys()}
        levels = {name: entry.level for name, entry in present.items()}
        if levels == self._told and clock.now() - self._told_at < _PERIOD_SECONDS:
            return
        self._sequence += 1
        data = encode_array(present | ended, self._sequence, self._node, status.name)
        with contextlib.suppress(ChannelFullError):  # the supervisor ends a relay that does not read
            self._relay.publish(OwnPublished(TOPIC, data))
            self._told, self._told_at = levels, clock.now()


def _string(text: str) -> bytes:
    data = text.encode("utf-8", "replace")
    return _LENGTH.pack(len(data)) + data


def _array(parts: list[bytes]) -> bytes:
    return _LENGTH.pack(len(parts)) + b"".join(parts)
