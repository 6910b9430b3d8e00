import math
from typing import Any

import pytest

from rosmop.tests.acting import message
from tests.unit.features.guards.guarding import Guarded, legs_of, twist

STILL, SLOW, FAST = twist(), twist(0.2), twist(1.0)
ZEROS = (0.0,) * 6


def switch(on: bool) -> bytes:
    return message("std_msgs/Bool", data=on)


def joy(*buttons: int) -> bytes:
    return message("sensor_msgs/Joy", buttons=list(buttons))


def scan(
    ranges: list[float], start: float = -1.5, step: float = 0.1, far: float = 10.0, low: float = 0.1
) -> bytes:
    return message(
        "sensor_msgs/LaserScan", angle_min=start, angle_increment=step, range_min=low, range_max=far,
        ranges=ranges,
    )  # fmt: skip


def moves(guard: Guarded, data: bytes, at: int, node: str = "/a") -> bool:
    return any(guard.drive(data, at, node))


def stops(guard: Guarded) -> list[int]:
    return [at for at, data in guard.got if legs_of(data) == ZEROS]


@pytest.mark.parametrize(("pressed", "other"), [((0, 1), (1, 0)), ((0, 1), ()), ((0, 1), (0, 2))])
def test_a_button_of_a_joystick_is_a_device(pressed: tuple[int, ...], other: tuple[int, ...]) -> None:
    guard = Guarded("hold_to_run", {"by": "sensor_msgs/Joy"}, button=1)
    guard.tell("by", joy(0, 0), 0, "/b")
    guard.tell("by", joy(*pressed), 10, "/b")
    moves(guard, STILL, 20)
    assert moves(guard, SLOW, 30)
    guard.tell("by", joy(*other), 40, "/b")
    assert not moves(guard, SLOW, 50)


def test_a_silent_mode_is_manual_and_stops_a_fast_base() -> None:
    guard = Guarded("mode")
    guard.tell("by", switch(False), 0, "/b")
    guard.drive(SLOW, 10)
    guard.drive(FAST, 20)
    guard.advance(1100)
    assert len(stops(guard)) == 1
    assert 1000 < stops(guard)[0] <= 1030


def test_a_node_must_be_slow_again_after_the_modes_nodes_are_forgotten() -> None:
    guard = Guarded("mode")
    guard.tell("by", switch(False), 0, "/b")
    guard.drive(SLOW, 10)
    guard.monitors.give({"guard": {"forget": 1}})
    guard.tell("by", switch(False), 12, "/b")
    assert guard.drive(FAST, 14)[0] == 0.25
    guard.drive(SLOW, 16)
    assert guard.drive(FAST, 18)[0] == 1.0


def test_a_parked_base_without_odometry_gets_no_stream_of_stops() -> None:
    guard = Guarded("standstill")
    guard.advance(60_000)
    assert guard.got == []


FREE = [math.inf] * 31
NEAR = [*FREE[:14], 0.6, 0.6, 0.6, *FREE[17:]]


def stopped_soon(guard: Guarded, at: int) -> bool:
    """Return whether the next tick after a scan stops the base."""
    guard.advance(at + 20)
    return at < stops(guard)[-1] <= at + 20


def clear_zone(**values: Any) -> Guarded:
    guard = Guarded("zone", **values)
    for at in range(0, 700, 100):
        guard.tell("by", scan(FREE), at, "/b")
    assert not moves(guard, STILL, 610)
    assert moves(guard, FAST, 620)
    return guard


def test_a_few_rays_and_things_beside_the_zone_do_not_count() -> None:
    guard = clear_zone()
    guard.tell("by", scan([*FREE[:14], 0.6, 0.6, *FREE[16:]]), 700, "/b")
    assert moves(guard, FAST, 710)
    guard.tell("by", scan([0.7] * 6 + FREE[:19] + [0.7] * 6), 800, "/b")
    assert moves(guard, FAST, 810)
    guard.tell("by", scan([*FREE[:14], 1.2, 1.2, 1.2, *FREE[17:]]), 900, "/b")
    assert moves(guard, FAST, 910)


FRONT = "0.1,-0.4 1,-0.4 1,0.4 0.1,0.4"
HORSESHOE = "-1,-1 2,-1 2,1 -1,1 -1,0.5 1.5,0.5 1.5,-0.5 -1,-0.5"
HIDDEN: list[tuple[str, float]] = [
    *[(FRONT, near) for near in (0.03, 0.06, 0.1)],
    ("1.2,-0.5 2.5,-0.5 2.5,0.5 1.2,0.5", 1.0),
    ("-0.3,0.5 0.3,0.5 0.3,1.5 -0.3,1.5", 0.3),
    ("-2,-0.4 -0.6,-0.4 -0.6,0.4 -2,0.4", 0.4),
    (HORSESHOE, 0.3),
    (HORSESHOE, 1.2),
]
"""Polygons before, beside, behind and around the scanner, and the distance of a thing all round that hides them."""


@pytest.mark.parametrize(("polygon", "near"), HIDDEN)
def test_a_zone_that_a_thing_before_it_hides_is_not_free(polygon: str, near: float) -> None:
    """A person who stands between the scanner and the zone, or a wall there: what is behind is not seen."""
    guard = Guarded("zone", polygon=polygon, clear=0)
    round_about = {"start": -math.pi, "step": math.pi / 180, "low": 0.02}
    for ranges, passes in (([5.0] * 360, True), ([near] * 360, False), ([5.0] * 360, True)):
        guard.tell("by", scan(ranges, **round_about), 100, "/b")
        moves(guard, STILL, 100)
        assert moves(guard, FAST, 100) == passes, ranges[0]


def test_parts_of_the_base_before_the_zone_are_its_own_only_if_an_operator_says_so() -> None:
    mast = [math.inf] * 170 + [0.15] * 20 + [math.inf] * 170
    for own, passes in ((0.0, False), (0.14, False), (0.2, True)):
        guard = Guarded("zone", polygon=FRONT, clear=0, own=own)
        guard.tell("by", scan(mast, start=-math.pi, step=math.pi / 180), 100, "/b")
        moves(guard, STILL, 100)
        assert moves(guard, FAST, 100) == passes


@pytest.mark.parametrize("reading", [3.2, math.nan, 0.0])
@pytest.mark.parametrize("rays", [1, 2, 3, 5])
def test_a_zone_is_not_free_if_all_rays_that_cross_it_end_in_it_or_see_nothing(
    rays: int, reading: float
) -> None:
    """Also if fewer than `points` cross it: a thing would never count."""
    edge = 3 * math.tan(0.1 * rays / 2 - 0.001)
    guard = Guarded("zone", polygon=f"3,{-edge} 3.3,{-edge} 3.3,{edge} 3,{edge}", points=20, clear=0)
    start, count = -0.05 * (rays - 1) - 0.1 * 3, rays + 6
    free = [math.inf] * count
    for ranges, passes in ((free, True), ([*free[:3], *[reading] * rays, *free[-3:]], False), (free, True)):
        guard.tell("by", scan(ranges, start=start, step=0.1), 100, "/b")
        moves(guard, STILL, 100)
        assert moves(guard, FAST, 100) == passes


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("x", [2, 4, 8])
def test_a_zone_that_no_ray_covers_is_not_free(x: int, side: int) -> None:
    """A narrow one too, between two directions, between two rays, and with one corner beside the last ray."""
    corners = f"{x},{0.01 * x * side} {x + 0.1},{0.01 * x * side} {x + 0.1},{0.045 * x * side} {x},{0.045 * x * side}"
    guard = Guarded("zone", polygon=corners, clear=0)
    for start, step, rays, passes in (
        (0.5, 0.01, 100, False), (-0.2, 0.01, 41, True), (-0.15, 0.15, 3, False),
        (-0.2 if side > 0 else -0.02, 0.01, 23, False),
    ):  # fmt: skip
        guard.tell("by", scan([math.inf] * rays, start=start, step=step), 100, "/b")
        moves(guard, STILL, 100)
        assert moves(guard, FAST, 100) == passes, (start, step, rays)


def test_a_slow_zone_limits_by_norm_and_frees_without_a_zero() -> None:
    guard = clear_zone(slow=0.3, turn=0.4)
    guard.tell("by", scan(NEAR), 700, "/b")
    got = guard.drive(twist(0.6, 0.8, 0, 0, 0, 1.0), 710)
    assert got == pytest.approx((0.18, 0.24, 0, 0, 0, 0.4))
    for at in range(800, 1500, 100):
        guard.tell("by", scan(FREE), at, "/b")
    assert guard.drive(FAST, 1410)[0] == 1


def test_muting_is_off_by_default_bounded_and_needs_a_signal_that_changes() -> None:
    guard = clear_zone()
    guard.tell("mute", switch(False), 630)
    guard.tell("mute", switch(True), 640)
    guard.tell("by", scan(NEAR), 700, "/b")
    assert stopped_soon(guard, 700)
    guard = clear_zone(muteFor=1)
    guard.tell("mute", switch(True), 640)
    guard.tell("by", scan(NEAR), 650, "/b")
    assert stopped_soon(guard, 650), "a signal that is on since the start does not mute"


def test_a_muted_zone_stops_again_after_its_time_or_without_the_signal() -> None:
    guard = clear_zone(muteFor=1)
    guard.tell("mute", switch(False), 630)
    for at in range(640, 1640, 100):
        guard.tell("mute", switch(True), at)
        guard.tell("by", scan(NEAR), at + 5, "/b")
        assert moves(guard, FAST, at + 10)
    guard.tell("mute", switch(True), 1650)
    guard.tell("by", scan(NEAR), 1660, "/b")
    assert not moves(guard, FAST, 1670)
    guard = clear_zone(muteFor=60)
    guard.tell("mute", switch(False), 630)
    guard.tell("mute", switch(True), 640)
    for at in range(700, 1300, 100):
        guard.tell("by", scan(NEAR), at, "/b")
    assert 1100 < stops(guard)[-1] <= 1220


def diagnostics(*entries: tuple[str, int] | tuple[str, int, str]) -> bytes:
    fields = ("name", "level", "hardware_id")
    status = [dict(zip(fields, entry, strict=False)) for entry in entries]
    return message("diagnostic_msgs/DiagnosticArray", status=status)


WELL = ("motor", 0)


@pytest.mark.parametrize(
    ("later", "values", "passes"),
    [
        ([("/b", ("motor", 0))], {}, True),
        ([("/b", ("motor", 1))], {}, True),
        ([("/b", ("motor", 1))], {"warnings": True}, False),
        *(([("/b", ("motor", level))], {}, False) for level in (2, 3, 4, -1)),
        ([("/b", ("other", 0))], {}, False),  # the entry no longer comes, while another one of its node does
        ([("/c", ("motor", 0))], {}, False),  # another node does not stand for it
        ([("/b", ("motor", 0)), ("/c", ("motor", 2))], {}, False),
        ([("/c", ("motor", 2)), ("/b", ("motor", 0))], {}, False),
        ([("/b", ("motor", 2), ("motor", 0))], {}, False),  # of two with one name the worse
        ([("/b", ("motor", 0), ("motor", 2))], {}, False),
        ([("/b", ("motor", 0), *((f"part {number}", 0) for number in range(63)))], {}, True),
        ([("/b", ("motor", 0), *((f"part {number}", 0) for number in range(64)))], {}, False),
        ([], {}, False),
    ],
)
def test_an_entry_that_is_bad_silent_or_missing_stops_the_base_until_a_zero(
    later: list[Any], values: dict[str, Any], passes: bool
) -> None:
    guard = Guarded("diagnostics", silent=1, **values)
    assert not moves(guard, STILL, 0)
    assert not moves(guard, SLOW, 10)
    guard.tell("by", diagnostics(WELL), 20, "/b")
    assert not moves(guard, SLOW, 30), "a node commands zero first"
    moves(guard, STILL, 40)
    assert moves(guard, SLOW, 50)
    for node, *entries in later:
        guard.tell("by", diagnostics(*entries), 900, node)
    assert moves(guard, SLOW, 1060) == passes
    if not passes:
        assert 900 <= stops(guard)[-1] <= 1060
        guard.monitors.give({"guard": {"forget": 1}})
        assert not moves(guard, STILL, 1070)
        guard.tell("by", diagnostics(WELL), 1080, "/b")
        assert not moves(guard, SLOW, 1090), "what comes again starts nothing"
        moves(guard, STILL, 1100)
        assert moves(guard, SLOW, 1110)


@pytest.mark.parametrize(
    ("named", "missing", "met"),
    [
        ("motor", ("motor 2", 0), ("motor", 0)),
        ("motor*", ("a motor", 0), ("motor 2", 0)),
        ("/Robot/*", ("Robot", 0), ("/Robot/Arm", 0)),
        ("hardware_id:0815", ("0815", 0, "08151"), ("motor", 0, "0815")),
        ("hardware_id:08*", ("08", 0, "18"), ("motor", 0, "0815")),
        ("motor, laser: *", ("motor", 0), ("laser: status", 0)),
    ],
)
def test_entries_have_a_name_a_beginning_or_a_hardware_id(named: str, missing: Any, met: Any) -> None:
    guard = Guarded("diagnostics", named=named)
    guard.tell("by", diagnostics(missing, ("unnamed", 2)), 0, "/b")
    moves(guard, STILL, 10)
    assert not moves(guard, SLOW, 20)
    guard.tell("by", diagnostics(missing, met, ("unnamed", 2)), 30, "/b")
    moves(guard, STILL, 40)
    assert moves(guard, SLOW, 50)
    guard.tell("by", diagnostics(missing, (met[0], 2, *met[2:]), ("unnamed", 0)), 60, "/b")
    assert not moves(guard, SLOW, 70)
