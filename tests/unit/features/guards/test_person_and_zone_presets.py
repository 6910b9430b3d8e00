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


def odometry(v: float = 0.0, w: float = 0.0) -> bytes:
    return message("nav_msgs/Odometry", twist__twist__linear__x=v, twist__twist__angular__z=w)


def scan(
    ranges: list[float], start: float = -1.5, step: float = 0.1, far: float = 10.0, low: float = 0.1
) -> bytes:
    return message(
        "sensor_msgs/LaserScan",
        angle_min=start,
        angle_increment=step,
        range_min=low,
        range_max=far,
        ranges=ranges,
    )


def moves(guard: Guarded, data: bytes, at: int, node: str = "/a") -> bool:
    return any(guard.drive(data, at, node))


def stops(guard: Guarded) -> list[int]:
    return [at for at, data in guard.got if legs_of(data) == ZEROS]


def held(at: int = 0) -> Guarded:
    guard = Guarded("enable")
    guard.tell("by", switch(False), at, "/b")
    guard.tell("by", switch(True), at + 10, "/b")
    assert not moves(guard, STILL, at + 20)
    assert moves(guard, SLOW, at + 30)
    return guard


def test_nothing_moves_without_an_enabling_device() -> None:
    guard = Guarded("enable")
    assert not moves(guard, SLOW, 10)
    guard.tell("by", switch(True), 20, "/b")  # tied down since the start
    assert not moves(guard, STILL, 30)
    assert not moves(guard, SLOW, 40)


def test_a_device_that_is_let_go_stops_the_base_at_once() -> None:
    guard = held()
    guard.tell("by", switch(False), 40, "/b")
    assert stops(guard)[-1] == 40
    assert not moves(guard, SLOW, 50)


def test_a_device_that_falls_silent_stops_the_base_and_has_to_be_pressed_again() -> None:
    guard = held()
    guard.advance(340)
    assert 310 <= stops(guard)[-1] <= 340
    guard.tell("by", switch(True), 350, "/b")
    assert not moves(guard, STILL, 360)
    assert not moves(guard, SLOW, 370)


def test_pressing_again_starts_nothing() -> None:
    guard = held()
    guard.tell("by", switch(False), 40, "/b")
    guard.tell("by", switch(True), 50, "/b")
    assert not moves(guard, SLOW, 60)
    assert not moves(guard, SLOW, 65, "/c")
    moves(guard, STILL, 70)
    assert moves(guard, SLOW, 80)
    assert not moves(guard, SLOW, 85, "/c"), "another node has not commanded zero"


def test_all_devices_have_to_be_held() -> None:
    guard = held()
    guard.tell("by", switch(False), 40, "/c")
    assert not moves(guard, SLOW, 50)
    guard.tell("by", switch(True), 60, "/c")
    guard.tell("by", switch(True), 60, "/b")
    moves(guard, STILL, 70)
    assert moves(guard, SLOW, 80)
    guard.tell("by", switch(True), 300, "/b")
    assert not moves(guard, SLOW, 380), "/c is silent, and /b does not hide it"


@pytest.mark.parametrize(("pressed", "other"), [((0, 1), (1, 0)), ((0, 1), ()), ((0, 1), (0, 2))])
def test_a_button_of_a_joystick_is_a_device(pressed: tuple[int, ...], other: tuple[int, ...]) -> None:
    guard = Guarded("enable", {"by": "sensor_msgs/Joy"}, button=1)
    guard.tell("by", joy(0, 0), 0, "/b")
    guard.tell("by", joy(*pressed), 10, "/b")
    moves(guard, STILL, 20)
    assert moves(guard, SLOW, 30)
    guard.tell("by", joy(*other), 40, "/b")
    assert not moves(guard, SLOW, 50)


def test_the_mode_is_manual_until_all_say_automatic() -> None:
    guard = Guarded("mode")
    assert math.hypot(*guard.drive(twist(0.9, 1.2), 10)[:2]) == pytest.approx(0.25)
    guard.tell("by", switch(False), 20, "/b")
    assert guard.drive(FAST, 30)[0] == 0.25, "a change of the mode starts no faster motion"
    assert guard.drive(SLOW, 40)[0] == 0.2
    assert guard.drive(FAST, 50)[0] == 1
    guard.tell("by", switch(True), 60, "/c")
    assert stops(guard) == [60]
    assert guard.drive(FAST, 70)[0] == 0.25


def test_a_silent_mode_is_manual_and_stops_a_fast_base() -> None:
    guard = Guarded("mode")
    guard.tell("by", switch(False), 0, "/b")
    guard.drive(SLOW, 10)
    guard.drive(FAST, 20)
    guard.advance(1100)
    assert len(stops(guard)) == 1
    assert 1000 < stops(guard)[0] <= 1030


@pytest.mark.parametrize("fast", [math.nan, math.inf, -math.inf, 1e300])
def test_a_command_without_a_size_passes_in_no_mode(fast: float) -> None:
    guard = Guarded("mode")
    assert max(map(abs, guard.drive(twist(fast), 0))) <= 0.25
    guard.tell("by", switch(False), 10, "/b")
    guard.drive(SLOW, 20)
    got = guard.drive(twist(fast), 30)
    assert got[0] == 0, "its square is infinite"


def stood(preset: str, **values: Any) -> Guarded:
    guard = Guarded(preset, **values)
    guard.tell("by", odometry(), 0, "/b")
    assert not moves(guard, STILL, 10)
    assert moves(guard, SLOW, 20)
    return guard


@pytest.mark.parametrize(
    "data", [odometry(0.7), odometry(0.1, 1.3), odometry(math.nan), odometry(0.0, math.inf)]
)
def test_a_base_that_is_measured_too_fast_stops_until_it_stands_and_zero_is_commanded(data: bytes) -> None:
    guard = stood("overspeed")
    guard.tell("by", data, 30, "/b")
    assert stops(guard)[-1] == 30
    assert not moves(guard, SLOW, 40)
    assert not moves(guard, STILL, 50)
    assert not moves(guard, SLOW, 60), "it has not stood"
    guard.tell("by", odometry(), 70, "/b")
    assert not moves(guard, SLOW, 80), "no zero was commanded since"
    moves(guard, STILL, 90)
    assert moves(guard, SLOW, 100)


@pytest.mark.parametrize("preset", ["overspeed", "standstill"])
def test_a_motion_needs_a_measurement_of_one_source(preset: str) -> None:
    guard = Guarded(preset)
    assert not moves(guard, STILL, 0)
    assert not moves(guard, SLOW, 10)
    guard = stood(preset)
    guard.tell("by", odometry(), 100, "/c")
    guard.advance(130)
    moves(guard, STILL, 140)
    guard.advance(1100)
    guard.tell("by", odometry(), 1110, "/b")
    moves(guard, STILL, 1120)
    assert moves(guard, SLOW, 1130)


def test_a_silent_measurement_of_the_velocity_stops_a_moving_base() -> None:
    guard = stood("overspeed")
    guard.advance(600)
    assert 500 < stops(guard)[-1] <= 540
    assert not moves(guard, SLOW, 610)


def test_a_base_that_moves_without_a_command_is_stopped_again_and_again() -> None:
    guard = stood("standstill")
    moves(guard, STILL, 100)
    for at in range(150, 1100, 50):
        guard.tell("by", odometry(0.3), at, "/b")
    assert stops(guard)[-1] == 100, "it may settle for a second"
    for at in range(1100, 1600, 50):
        guard.tell("by", odometry(0.3), at, "/b")
    assert len([at for at in stops(guard) if at > 1100]) >= 4
    assert not moves(guard, SLOW, 1610)
    guard.tell("by", odometry(0.0), 1620, "/b")
    assert not moves(guard, SLOW, 1630)
    moves(guard, STILL, 1640)
    assert moves(guard, SLOW, 1650)


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


def test_a_thing_in_the_zone_stops_the_base_until_it_is_clear_and_zero_is_commanded() -> None:
    guard = clear_zone()
    guard.tell("by", scan(NEAR), 700, "/b")
    assert stopped_soon(guard, 700)
    assert not moves(guard, FAST, 730)
    for at in range(800, 1500, 100):
        guard.tell("by", scan(FREE), at, "/b")
    assert not moves(guard, FAST, 1410)
    moves(guard, STILL, 1420)
    assert moves(guard, FAST, 1430)


@pytest.mark.parametrize(
    "ranges",
    [
        [math.nan] * 31,
        [0.0] * 31,
        [0.05] * 31,
        [-1.0] * 31,
        [*FREE[:10], *[math.nan] * 5, *FREE[15:]],
        [],
        FREE[:16],
    ],
)
def test_a_scan_that_does_not_see_the_zone_stops(ranges: list[float]) -> None:
    guard = clear_zone()
    guard.tell("by", scan(ranges), 700, "/b")
    assert stopped_soon(guard, 700)
    assert not moves(guard, FAST, 730)


@pytest.mark.parametrize(
    "data",
    [
        scan(FREE, far=0.0),
        scan(FREE, far=0.5),
        scan([math.inf] * len(FREE), far=math.inf),
        scan(FREE, start=math.nan),
        scan(FREE, step=0.0),
    ],
)
def test_a_scan_with_a_wrong_head_stops(data: bytes) -> None:
    guard = clear_zone()
    guard.tell("by", data, 700, "/b")
    assert stopped_soon(guard, 700)


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


def test_a_silent_scanner_stops() -> None:
    guard = clear_zone()
    guard.advance(1000)
    assert 900 < stops(guard)[-1] <= 940
    assert not moves(guard, FAST, 1010)


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
