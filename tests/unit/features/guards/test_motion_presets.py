import math
from itertools import product

import pytest

from rosmop.tests.acting import message
from rosmop.tests.examples import sample
from tests.unit.features.guards.guarding import Guarded, legs_of, twist

STILL = twist()


def test_a_deadman_stops_for_each_node_that_falls_silent() -> None:
    """A node that drives on does not hide it; the commands of one that begins again stop no other."""
    guard = Guarded("deadman")
    for at in range(20, 2000, 20):
        for node, last, again in (("/a", 400, 800), ("/b", 1200, 1600)):
            if not last < at < again:
                guard.drive(twist(0.5), at, node)
    assert [at for at, data in guard.got if data == STILL and at > 420] == [710, 1510]


@pytest.mark.parametrize("gap", [280, 300, 301, 309, 340])
def test_a_deadman_stops_within_its_time_and_a_tick(gap: int) -> None:
    guard = Guarded("deadman", resume=0)
    for at in (20, 20 + gap):
        guard.drive(twist(0.5), at)
    stops = [at for at, data in guard.got if data == STILL]
    assert stops == ([330] if gap >= 310 else [])
    guard.got.clear()
    guard.advance(1000)
    first, second, *_ = (at for at, _data in guard.got)
    assert first <= 20 + gap + 300 + 10 and second == first + 100


@pytest.mark.parametrize("gap", [300, 301, 309])
def test_a_node_that_returns_before_the_tick_has_been_silent(gap: int) -> None:
    """Also while another node drives the base."""
    guard = Guarded("deadman")
    last = 520
    for at in range(20, last + gap, 20):
        guard.drive(twist(0.5), at, "/a")
        if at <= last:
            guard.drive(twist(0.4), at, "/b")
    guard.got.clear()
    guard.drive(twist(0.4), last + gap, "/b")
    assert any(data == STILL for _at, data in guard.got) == (gap > 300)


# Fence


def odometry(x: float, y: float, yaw: float) -> bytes:
    return message(
        "nav_msgs/Odometry",
        pose__pose__position__x=x,
        pose__pose__position__y=y,
        pose__pose__orientation__z=math.sin(yaw / 2),
        pose__pose__orientation__w=math.cos(yaw / 2),
    )


@pytest.mark.parametrize("thick", [0.01, 0.1])
@pytest.mark.parametrize(
    ("speed", "margin", "ahead"), [(2.0, 0.05, 1), (3.0, 0.1, 1), (5.0, 0.2, 1), (5.0, 0.0, 2)]
)
def test_a_fast_base_does_not_drive_across_a_thin_part_outside(
    speed: float, margin: float, ahead: float, thick: float
) -> None:
    """A line that no base may cross is a thin notch of the polygon, beside the places that the guard looks at."""
    polygon = f"0,0 20,0 20,8 {20 + thick},8 {20 + thick},0 40,0 40,10 0,10"
    for begin in sample((5.0, 11.3, 19.0)):
        guard, x, v = Guarded("fence", margin=margin, ahead=ahead, polygon=polygon), begin, 0.0
        for at in range(0, 8000, 10):
            if at % 100 == 0:
                guard.tell("by", odometry(x, 5, 0), at)
            if at % 50 == 0:
                guard.drive(twist(speed), at)
            guard.advance(at)
            wanted = legs_of(guard.got[-1][1])[0]
            v = max(wanted, v - 0.01 * speed / (0.9 * ahead))
            x += v / 100
        assert begin < x < 20


@pytest.mark.parametrize("inward", [0.3, 1.0, 2.0])
def test_a_motion_from_the_margin_leads_across_no_part_outside(inward: float) -> None:
    polygon = "0,0 20,0 20,8 20.02,8 20.02,0 40,0 40,10 0,10"
    for here, before, turned in product((0.05, 0.1), (0.1, 0.2, 0.3, 0.5), (0.5, 0.8, 1.1)):
        guard = Guarded("fence", polygon=polygon, inward=inward)
        guard.tell("by", odometry(20 - before, here, turned), 0)
        guard.tell("by", odometry(20 - before, here, turned), 100)
        v = guard.drive(twist(inward), 110)[0]
        assert v * (0.15 + 0.5) * math.cos(turned) < before, (here, before, turned)


@pytest.mark.parametrize(
    "polygon", ["-2,-2 -2,2 2,2 2,-2", "-2,-2 0,-2 2,-2 2,2 -2,2", "-2,-2 -2,-2 2,-2 2,2 -2,2"]
)
def test_a_fence_may_be_clockwise_and_have_corners_on_an_edge(polygon: str) -> None:
    guard = Guarded("fence", polygon=polygon)
    for at, (x, passes) in enumerate(((0, True), (1.8, False), (-1.9, True), (3, False)), 1):
        guard.tell("by", odometry(x, 0, 0), at)
        assert (guard.drive(twist(0.3), at)[0] == 0.3) == passes


def test_a_fence_by_satellites_is_in_metres_from_its_origin() -> None:
    def passes(metres: float, y: float, *, fixed: int = 0, world: bool = True) -> bool:
        guard = Guarded("fence", {"by": "sensor_msgs/NavSatFix"}, worldFrame=world, lat0=48, lon0=11,
                        polygon="-50,-50 50,-50 50,50 -50,50")  # fmt: skip
        fix = {"latitude": 48 + metres / 111_200, "longitude": 11.0, "status__status": fixed}
        guard.tell("by", message("sensor_msgs/NavSatFix", **fix), 1)
        return guard.drive(twist(0, y), 2)[1] == y

    assert [passes(metres, y) for metres in (0, 49.6, 51, -51) for y in (0.3, -0.3)] == [
        True, True, False, True, False, True, True, False,
    ]  # fmt: skip
    assert not passes(0, 0.3, fixed=-1) and not passes(math.nan, 0.3) and not passes(0, 0.3, world=False)


# Separation


def scan(ranges: list[float], start: float = -math.pi, step: float = 0.0) -> bytes:
    return message("sensor_msgs/LaserScan", angle_min=start, angle_increment=step or 2 * math.pi / max(len(ranges), 1),
                   range_min=0.1, range_max=10.0, ranges=ranges)  # fmt: skip


def rays(count: int = 72, start: float = -math.pi) -> list[float]:
    return [start + place * 2 * math.pi / count for place in range(count)]


def wall(metres: float, direction: float, at: float = 0.0, x: float = 0.0) -> list[float]:
    """Return the distances of 72 rays to a wall across `direction`."""
    found = []
    for angle in rays():
        toward = math.cos(angle + at - direction)
        found.append((metres - x * math.cos(direction)) / toward if toward > 0.1 else math.inf)
    return [min(one, math.inf) if 0.1 <= one <= 10 else math.inf for one in found]


def seen(guard: Guarded, ranges: list[float], at: int = 1, times: int = 20) -> int:
    """Give scans at 10 Hz, and return the time of the last one."""
    for _ in range(times):
        guard.tell("by", scan(ranges), at)
        at += 100
    return at - 100


@pytest.mark.parametrize("away", [0.4, -0.7, math.pi / 4, 2.0, -2.5, 3 * math.pi / 4])
def test_a_base_retreats_from_a_near_wall_in_any_direction(away: float) -> None:
    """From the second scan on: the guard measures the way in the direction of the last command."""
    guard, back = Guarded("separation"), twist(0.2 * math.cos(away), 0.2 * math.sin(away))
    at = seen(guard, wall(0.3, away + math.pi))
    guard.drive(back, at)
    at = seen(guard, wall(0.3, away + math.pi), at + 100, 1)
    assert legs_of(back) == guard.drive(back, at)
    aside = [0.04 * math.cos(away + 0.04), 0.04 * math.sin(away + 0.04)]
    assert guard.drive(twist(*aside), at) == (*aside, 0, 0, 0, 0)
    forth = guard.drive(twist(-0.2 * math.cos(away), -0.2 * math.sin(away)), at)
    assert forth[:3] == (0, 0, 0)
    at = seen(guard, wall(0.3, away), at + 100, 1)
    assert guard.drive(back, at)[:3] == (0, 0, 0)


def test_the_old_way_counts_until_a_fast_base_has_turned() -> None:
    """A base at 1.5 m/s drifts for metres between the two ways. A post there is beside each of them."""
    guard = Guarded("separation", person=0, braking=0.5)
    post = [2.0 if abs(angle - 0.58) < 0.05 else math.inf for angle in rays()]
    at = seen(guard, post)
    for direction, passes in ((0.0, True), (1.16, False)):
        legs = twist(1.5 * math.cos(direction), 1.5 * math.sin(direction))
        for _ in range(3):
            guard.drive(legs, at)
            at = seen(guard, post, at + 100, 1)
        assert (math.hypot(*guard.drive(legs, at)[:2]) == pytest.approx(1.5)) is passes
    for _ in range(40):
        at = seen(guard, post, at + 100, 1)
        got = guard.drive(legs, at)
    assert math.hypot(*got[:2]) == pytest.approx(1.5)


@pytest.mark.parametrize("blank", [math.nan, 0.0, -math.inf, 0.05, 11.0, -1.0])
def test_a_direction_without_a_measurement_counts_as_near(blank: float) -> None:
    """A bag over the scanner, or a person who touches it, is not free space."""
    for places in (range(72), range(30, 43), [36]):
        ranges = [blank if place in places else math.inf for place in range(72)]
        guard, free = Guarded("separation"), Guarded("separation", blankIsFree=True)
        at = max(seen(guard, ranges), seen(free, ranges))
        assert guard.drive(twist(1.0), at)[0] == 0
        assert (free.drive(twist(1.0), at)[0] > 0) == (blank != 0.05 and not blank < 0)
        back = guard.drive(twist(-1.0), at)[0]
        assert (back < 0) == (len([*places]) < 72)


@pytest.mark.parametrize(
    ("start", "step", "count"),
    [
        (0.3, 0.05, 80),
        (-0.3, 0.05, 13),
        (-1.5, 0.5, 7),
        (math.nan, 0.05, 72),
        (-1.5, math.nan, 72),
        (0, 0, 72),
        (0, 0, 1),
    ],
)
def test_directions_without_rays_count_as_near(start: float, step: float, count: int) -> None:
    guard = Guarded("separation")
    for at in range(0, 1000, 100):
        guard.tell("by", message("sensor_msgs/LaserScan", angle_min=start, angle_increment=step, range_min=0.1,
                                 range_max=10.0, ranges=[math.inf] * count), at)  # fmt: skip
    assert guard.drive(twist(1.0), 900)[0] == 0


@pytest.mark.parametrize("far", [0.0, -1.0, math.nan, math.inf])
def test_nothing_in_a_range_of_nothing_is_not_free(far: float) -> None:
    guard = Guarded("separation")
    guard.tell("by", message("sensor_msgs/LaserScan", angle_min=-math.pi, angle_increment=math.pi / 36, range_min=0.1,
                             range_max=far, ranges=[math.inf] * 72), 1)  # fmt: skip
    assert guard.drive(twist(1.0), 2)[0] == 0


@pytest.mark.parametrize("start", [-math.pi, 0.0, -2 * math.pi])
def test_a_sector_is_ahead_whatever_the_first_angle_is(start: float) -> None:
    for mounted in (0.0, math.pi):
        front = -1.0 if mounted else 1.0
        guard = Guarded("separation", sector=1.0, unseen=0.25, mounted=round(mounted, 6), person=0)
        free = Guarded("separation", sector=1.0, mounted=round(mounted, 6), person=0)
        near = [0.4 if abs(math.remainder(angle, 2 * math.pi)) < 0.1 else 9.0 for angle in rays(start=start)]
        behind = [0.4 if abs(math.remainder(angle, 2 * math.pi)) > 3 else 9.0 for angle in rays(start=start)]
        for one in (guard, free):
            one.tell("by", scan(near, start), 1)
        assert abs(guard.drive(twist(front), 2)[0]) < 0.3
        assert guard.drive(twist(-front), 3)[0] == -front * 0.25 and free.drive(twist(-front), 3)[0] == 0
        guard.drive(twist(), 4)
        guard.tell("by", scan(behind, start), 4000)
        assert guard.drive(twist(front), 4001)[0] == front


@pytest.mark.parametrize("legs", [(0.0, 0.0, -1.5), (0.01, 0.0, -1.5), (1e-300, 0.0, 1.5), (0.5, 0.2, 1.0)])
def test_a_steep_motion_needs_everything_around_the_base_free(legs: tuple[float, ...]) -> None:
    """Also with a small velocity ahead, where nothing is; a flat motion needs only its way."""
    angles = [-math.pi + math.pi / 90 * ray for ray in range(181)]
    for beside, passes in ((9.0, True), (0.6, False)):
        guard = Guarded("separation")
        ranges = [beside if abs(abs(angle) - math.pi / 2) < 0.3 else 9.0 for angle in angles]
        scan = {"angle_min": -math.pi, "angle_increment": math.pi / 90, "range_min": 0.1, "range_max": 10.0}
        for at in (0, 50):
            guard.tell("by", message("sensor_msgs/LaserScan", **scan, ranges=ranges), at)
        assert (guard.drive(twist(*legs), 60)[:3] == legs) == passes
        assert guard.drive(twist(0.5, 0.0, 0.05), 70)[:3] == (0.5, 0.0, 0.05)
