"""A zero lets go; everything else moves."""

import math
import struct

import pytest

from appliance.relay.velocity_zero import LAYOUTS, moves_of
from roswire.standard import standard_definitions

STAMP = struct.pack("<IIII", 7, 1, 2, 4) + b"base"
BODIES = {
    "geometry_msgs/Twist": (b"", 6, "d", b""),
    "geometry_msgs/TwistStamped": (STAMP, 6, "d", b""),
    "ackermann_msgs/AckermannDrive": (b"", 3, "f", struct.pack("<2f", 1, 1)),
    "ackermann_msgs/AckermannDriveStamped": (STAMP, 3, "f", struct.pack("<2f", 1, 1)),
}


def moves(kind: str, body: bytes) -> bool:
    return moves_of({"type": kind, "md5sum": LAYOUTS[kind].md5sum})(memoryview(body))


def test_the_layouts_have_the_md5sums_of_the_definitions() -> None:
    """A publisher with another definition has no zero."""
    known = standard_definitions()
    assert LAYOUTS.keys() == BODIES.keys()
    assert {kind: layout.md5sum for kind, layout in LAYOUTS.items()} == {
        kind: known.md5sum(kind) for kind in LAYOUTS
    }


@pytest.mark.parametrize("kind", BODIES)
def test_each_velocity_moves(kind: str) -> None:
    """A negative zero does not; NaN does. A limit of the acceleration does not."""
    before, count, letter, behind = BODIES[kind]
    for place in range(count):
        for value, expected in ((0.0, False), (-0.0, False), (1e-30, True), (-1.0, True), (math.nan, True)):
            values = [0.0] * count
            values[place] = value
            assert moves(kind, before + struct.pack(f"<{count}{letter}", *values) + behind) is expected


@pytest.mark.parametrize("kind", BODIES)
def test_bytes_of_another_form_move(kind: str) -> None:
    """A torn message is not letting go."""
    before, count, letter, behind = BODIES[kind]
    whole = before + struct.pack(f"<{count}{letter}", *[0.0] * count) + behind
    for size in range(len(whole)):
        assert moves(kind, whole[:size])
    assert moves(kind, whole + b"\0")


def test_each_message_of_another_type_moves() -> None:
    """Also one with the name of a velocity's type and another definition."""
    assert moves_of({"type": "std_msgs/Empty", "md5sum": "x"})(memoryview(b""))
    assert moves_of({"type": "geometry_msgs/Twist", "md5sum": "x"})(memoryview(bytes(48)))
    assert moves_of({})(memoryview(bytes(48)))
