"""Compute what the last recorded scans would permit, by running a guard's own text on them in the engine.

A copy of the guard gets the scans at their times, as messages of one node, and then a fast command straight ahead. The
part of that command that passes is permitted.
"""

import struct
from collections.abc import Mapping, Sequence

from appliance.features.guards.presets import PRESETS, Guard, text_of
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender
from roswire.standard import standard_definitions

SCAN = "sensor_msgs/LaserScan"
WITHOUT: Mapping[str, Mapping[str, str]] = {"separation": {"person": "0"}}
"""The presets that limit a velocity by a scan, with the values whose effect is also shown."""
MOST_SCANS = 6
"""The interval of the scans counts, and it is known after a few."""
_FAST = 100.0
_VELOCITY = struct.Struct("<6d")


Scans = Sequence[tuple[int, bytes]]
"""Times in nanoseconds, with messages."""


def permitted(preset: str, values: Mapping[str, str], scans: Scans) -> float | None:
    """Return the velocity straight ahead, in m/s, that a guard would let pass right after the last scan.

    None: the last of the scans is not a valid message.
    """
    topics = {"command": "/command", "by": "/scan"}
    types = {"command": "geometry_msgs/Twist", "by": SCAN}
    text = text_of(Guard("guard", PRESETS[preset], topics, types, values))
    monitors = MonitorSet.of(compiled_from({"guard.rv": text}, standard_definitions(), lints=False))
    monitors.start(scans[0][0])
    for time, data in scans:
        outcome = monitors.process("/scan", bytearray(data), time, MessageSender(1))
    if outcome.faults:
        return None
    command = bytearray(_VELOCITY.pack(_FAST, 0, 0, 0, 0, 0))
    passed = monitors.process("/command", command, scans[-1][0], MessageSender(2))
    return 0.0 if passed.result == "dropped" else float(_VELOCITY.unpack_from(passed.buffer)[0])
