"""Find out whether a message commands a motion: each message does, except a zero of a type of velocities.

The types and their fields are those of the guards' presets. Acceleration and jerk of the Ackermann types are limits,
which move nothing.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

_HEADER = 16  # seq, stamp and the length of frame_id, which follows
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class VelocityLayout:
    """Where a serialized message has its velocities: `format` at its beginning, or behind a `std_msgs/Header`."""

    md5sum: str
    format: struct.Struct
    size: int
    stamped: bool = False

    def moves(self, body: memoryview) -> bool:
        """Whether a velocity is not zero; NaN is a motion, as are bytes of any other form."""
        start = 0
        if self.stamped:
            if len(body) < _HEADER:
                return True
            start = _HEADER + _LENGTH.unpack_from(body, _HEADER - _LENGTH.size)[0]
        if len(body) != start + self.size:
            return True
        return any(value != 0 for value in self.format.unpack_from(body, start))


_TWIST, _STEERING = struct.Struct("<6d"), struct.Struct("<3f")

LAYOUTS: Mapping[str, VelocityLayout] = {
    "geometry_msgs/Twist": VelocityLayout("9f195f881246fdfa2798d1d3eebca84a", _TWIST, 48),
    "geometry_msgs/TwistStamped": VelocityLayout(
        "98d34b0043a2093cf9d9345ab6eef12e", _TWIST, 48, stamped=True
    ),
    "ackermann_msgs/AckermannDrive": VelocityLayout("3512e91b48d69674a0e86fadf1ea8231", _STEERING, 20),
    "ackermann_msgs/AckermannDriveStamped": VelocityLayout(
        "1fd5d7f58889cefd44d29f6653240d0c", _STEERING, 20, stamped=True
    ),
}


def _always(_body: memoryview) -> bool:
    return True


def moves_of(header: Mapping[str, str]) -> Callable[[memoryview], bool]:
    """Return whether a message's body moves, for a publisher with this connection header."""
    layout = LAYOUTS.get(header.get("type", ""))
    if layout is None or layout.md5sum != header.get("md5sum"):
        return _always
    return layout.moves
