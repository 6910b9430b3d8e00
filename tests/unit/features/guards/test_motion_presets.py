import math
from typing import Any

import pytest

from rosmop.tests.acting import message
from rosmop.tests.examples import examples
from tests.unit.features.guards.guarding import (
    BEGIN,
    MS,
    NODES,
    SPEEDS,
    Guarded,
    legs_of,
    same,
    seeded,
    twist,
)

STILL = twist()
TRACES = range(examples(1000))


def seconds(at: int) -> float:
    whole, rest = divmod(BEGIN + at * MS, 10**9)
    return whole + rest * 1e-9


def moves(data: bytes) -> bool:
    return any(leg != 0 for leg in legs_of(data))


def deadman(commands: list[tuple[int, bytes, str]], end: int, silent: float) -> list[tuple[int, bytes]]:
    got: list[tuple[int, bytes]] = []
    movers: dict[str, float] = {}
    stopped, pause = False, 0
    for now in range(1, end + 1):
        if now % 10 == 0:
            late = [node for node, at in movers.items() if not seconds(now) - at <= silent]
            for node in late:
                del movers[node]
            if late:
                stopped, pause = True, 0
            if stopped and pause == 0:
                got.append((now, STILL))
            pause = 9 if pause == 0 else pause - 1
        for _at, data, node in (one for one in commands if one[0] == now):
            if moves(data) and node not in movers and len(movers) == 2:
                got.append((now, STILL))
                continue
            movers.pop(node, None) if not moves(data) else movers.update({node: seconds(now)})
            stopped = False
            got.append((now, data))
    return got


def test_a_deadman_stops_for_each_node_that_falls_silent() -> None:
    random = seeded(1)
    for _trace in TRACES:
        guard = Guarded("deadman")
        commands = sorted(
            ((random.randint(1, 1500), twist(random.choice(SPEEDS), 0, 0, 0, 0, random.choice(SPEEDS)), node)
             for node in NODES[1:] for _ in range(random.randint(0, 5))), key=lambda one: one[0]
        )  # fmt: skip
        for at, data, node in commands:
            guard.tell("command", data, at, node)
        guard.advance(2000)
        assert guard.got == deadman(commands, 2000, 0.3), commands


@pytest.mark.parametrize("gap", [280, 300, 301, 309, 340])
def test_a_deadman_stops_within_its_time_and_a_tick(gap: int) -> None:
    guard = Guarded("deadman")
    for at in (20, 20 + gap):
        guard.drive(twist(0.5), at)
    stops = [at for at, data in guard.got if data == STILL]
    assert stops == ([330] if gap >= 310 else [])
    guard.got.clear()
    guard.advance(1000)
    first, second, *_ = (at for at, _data in guard.got)
    assert first <= 20 + gap + 300 + 10 and second == first + 100


def axis(wanted: float, last: float, most: float, growth: float) -> float:
    if math.isnan(wanted):
        return 0.0
    start = abs(last) if wanted * last > 0 else 0.0
    bound = max(0.0, min(start + growth, most))
    return math.copysign(min(abs(wanted), bound), wanted) if wanted else wanted


def test_a_speed_limit_bounds_velocities_and_their_growth() -> None:
    random = seeded(2)
    for _trace in TRACES:
        growth = random.choice((0.8, 20.0))
        guard, before, last = Guarded("speed", vMax=0.5, aMax=growth), -math.inf, [0.0] * 6
        at = 0
        for _command in range(8):
            at += random.choice((1, 20, 100, 200, 500, 1000, 1001, 3000))
            wanted = [random.choice(SPEEDS) for _ in range(6)]
            elapsed = ((at - before) * MS) / 1e9
            passed = min(elapsed, 0.2)
            if not elapsed <= 1:
                passed, last = 0.1, [0.0] * 6
            last = [axis(leg, was, *((0.5, growth * passed) if place < 3 else (1, 3 * passed)))
                    for place, (leg, was) in enumerate(zip(wanted, last, strict=True))]  # fmt: skip
            assert guard.drive(twist(*wanted), at) == tuple(last), (wanted, at)
            before = at


def test_a_limit_of_zero_stops() -> None:
    guard = Guarded("speed", vMax=0, wMax=0)
    assert guard.drive(twist(*[9.0] * 6), 100) == (0,) * 6


@pytest.mark.parametrize("place", range(6))
@pytest.mark.parametrize("leg", SPEEDS)
def test_only_finite_commands_are_sane(place: int, leg: float) -> None:
    legs = [0.1] * 6
    legs[place] = leg
    assert Guarded("sane").drive(twist(*legs), 1) == (tuple(legs) if math.isfinite(leg) else (0,) * 6)


def test_a_rate_drops_motions_and_never_a_stop() -> None:
    random = seeded(3)
    for _trace in TRACES:
        guard, left, before, at = Guarded("rate", interval=0.1, burst=3), 0.0, -math.inf, 0
        for _command in range(12):
            at += random.choice((0, 1, 50, 100, 101, 1000))
            legs = [random.choice(SPEEDS) if random.random() < 0.3 else 0.0 for _ in range(6)]
            available = max(0.0, min(left + ((at - before) * MS) / 1e9 / 0.1, 3))
            passes = available >= 1 or not any(legs)
            got = guard.drive(twist(*legs), at)
            assert same(got, legs) if passes else got == ()
            if passes:
                left, before = max(0.0, min(available - 1, 3)), at


# Fence


def odometry(x: float, y: float, yaw: float) -> bytes:
    return message(
        "nav_msgs/Odometry",
        pose__pose__position__x=x,
        pose__pose__position__y=y,
        pose__pose__orientation__z=2 * math.sin(yaw / 2),
        pose__pose__orientation__w=2 * math.cos(yaw / 2),
    )


def depth(x: float, y: float) -> float:
    """Return the distance in metres to the edge of the 4 m square, negative outside."""
    if max(abs(x), abs(y)) <= 2:
        return 2 - max(abs(x), abs(y))
    return -math.hypot(max(abs(x) - 2, 0), max(abs(y) - 2, 0))


def simulated(guard: Guarded, random: Any, x: float, y: float, turned: float) -> list[float]:
    depths, x_speed, y_speed, turning, at = [], 0.0, 0.0, 0.0, 0
    for step in range(400):
        at += 10
        if step % 5 == 0:
            guard.tell("by", odometry(x, y, turned), at)
        if step % 7 == 0 and random.random() < 0.1:
            legs = [random.choice((0.0, 0.3, 1.0, -1.0, math.nan, math.inf)) for _ in range(2)]
            guard.drive(twist(legs[0], legs[1], 0, 0, 0, random.choice((0.0, 1.0, -2.0))), at)
        guard.advance(at)
        x_speed, y_speed, *_, turning = legs_of(guard.got[-1][1]) if guard.got else (0.0,) * 6
        x += (x_speed * math.cos(turned) - y_speed * math.sin(turned)) / 100
        y += (x_speed * math.sin(turned) + y_speed * math.cos(turned)) / 100
        turned += turning / 100
        depths.append(depth(x, y))
    return depths


def test_a_base_stays_inside_a_fence() -> None:
    random = seeded(4)
    for _trace in range(examples(120)):
        depths = simulated(Guarded("fence"), random, random.uniform(-1.7, 1.7), random.uniform(-1.7, 1.7),
                           random.uniform(-4, 4))  # fmt: skip
        assert min(depths) > 0 and not any(map(math.isnan, depths))


def test_a_base_outside_a_fence_only_comes_back() -> None:
    random = seeded(5)
    for _trace in range(examples(120)):
        side = random.choice(((3.0, 0.5), (-3.0, 1.0), (0.0, 3.0), (1.5, -3.0), (3.0, 3.0)))
        depths = simulated(Guarded("fence"), random, *side, random.uniform(-4, 4))
        assert min(depths) > depth(*side) - 0.1
        guard = Guarded("fence")
        inward = math.atan2(-side[1], -side[0])
        guard.tell("by", odometry(*side, inward), 1)
        assert guard.drive(twist(0.4), 2)[0] == 0.4 and guard.drive(twist(-0.4), 3)[0] == 0
        assert guard.drive(twist(0, 0, 0, 0, 0, 1.0), 4)[5] == 1.0


def test_without_a_position_only_turns_pass() -> None:
    guard = Guarded("fence")
    assert guard.drive(twist(0.1), 1)[0] == 0
    guard.tell("by", odometry(0, 0, 0), 2)
    assert guard.drive(twist(0.1), 502)[0] == 0.1
    guard.got.clear()
    guard.advance(600)
    assert [legs_of(data) for _at, data in guard.got] == [(0,) * 6]
    assert guard.drive(twist(0.1), 601)[0] == 0
    guard.tell("by", odometry(math.nan, 0, 0), 601)
    assert guard.drive(twist(0.1), 602)[0] == 0 and guard.drive(twist(0, 0, 0, 0, 0, 1.0), 603)[5] == 1


@pytest.mark.parametrize(
    "polygon", ["-2,-2 -2,2 2,2 2,-2", "-2,-2 0,-2 2,-2 2,2 -2,2", "-2,-2 -2,-2 2,-2 2,2 -2,2"]
)
def test_a_fence_may_be_clockwise_and_have_corners_on_an_edge(polygon: str) -> None:
    guard = Guarded("fence", polygon=polygon)
    for at, (x, passes) in enumerate(((0, True), (1.7, False), (-1.9, True), (3, False)), 1):
        guard.tell("by", odometry(x, 0, 0), at)
        assert (guard.drive(twist(0.4), at)[0] == 0.4) == passes


@pytest.mark.parametrize("orientation", [(0, 0, 0, 0), (0, 0, 0.01, 0), (0, 0, 0, math.inf)])
def test_without_a_direction_only_turns_pass(orientation: tuple[float, ...]) -> None:
    """A driver that knows no direction sends zeros, which do not mean the direction of the x axis."""
    parts = {f"pose__pose__orientation__{axis}": part for axis, part in zip("xyzw", orientation, strict=True)}
    pose = message("nav_msgs/Odometry", **parts)
    guard, world = Guarded("fence"), Guarded("fence", worldFrame=True)
    for one in (guard, world):
        one.tell("by", pose, 1)
    assert guard.drive(twist(0.1), 2)[0] == 0 and guard.drive(twist(0, 0, 0, 0, 0, 1.0), 3)[5] == 1
    assert world.drive(twist(0.1), 2)[0] == 0.1


def test_a_fence_by_satellites_is_in_metres_from_its_origin() -> None:
    def passes(metres: float, y: float, *, fixed: int = 0, world: bool = True) -> bool:
        guard = Guarded("fence", {"by": "sensor_msgs/NavSatFix"}, worldFrame=world, lat0=48, lon0=11,
                        polygon="-50,-50 50,-50 50,50 -50,50")  # fmt: skip
        fix = {"latitude": 48 + metres / 111_200, "longitude": 11.0, "status__status": fixed}
        guard.tell("by", message("sensor_msgs/NavSatFix", **fix), 1)
        return guard.drive(twist(0, y), 2)[1] == y

    assert [passes(metres, y) for metres in (0, 49.6, 51, -51) for y in (1, -1)] == [
        True, True, False, True, False, True, True, False,
    ]  # fmt: skip
    assert not passes(0, 1, fixed=-1) and not passes(math.nan, 1) and not passes(0, 1, world=False)


# Separation


def scan(ranges: list[float], start: float = -math.pi) -> bytes:
    step = 2 * math.pi / max(len(ranges), 1)
    return message("sensor_msgs/LaserScan", angle_min=start, angle_increment=step, range_min=0.1, range_max=10.0,
                   ranges=ranges)  # fmt: skip


def test_a_base_can_stop_before_the_nearest_thing() -> None:
    random, (reaction, braking, person, margin) = seeded(6), (0.2, 1.0, 1.6, 0.3)
    for _trace in TRACES:
        guard = Guarded("separation", reaction=reaction, braking=braking, person=person, margin=margin)
        ranges = [random.choice((0.0, 0.5, 1.5, 3.0, 9.0, 11.0, math.inf, math.nan)) for _ in range(8)]
        guard.tell("by", scan(ranges), 1)
        valid = [one for one in ranges if 0.1 < one < 10 or math.isinf(one)]
        nearest = min(valid, default=0.0)
        wanted = random.choice((0.05, 0.5, 2.0, 1e9, math.nan))
        got = guard.drive(twist(-wanted, wanted, 0), 2)
        assert got[0] == -got[1]
        speed = got[1]
        needed = speed * reaction + speed**2 / (2 * braking) + person * (reaction + speed / braking) + margin
        assert speed == 0 or needed <= nearest * (1 + 1e-9)
        assert (
            speed == wanted
            or math.isnan(wanted)
            or nearest <= needed * (1 + 1e-9)
            or speed == 0 >= nearest - needed
        )


@pytest.mark.parametrize("start", [-math.pi, 0.0, -2 * math.pi])
def test_a_sector_is_ahead_whatever_the_first_angle_is(start: float) -> None:
    guard = Guarded("separation", sector=0.5)
    places = [start + place * math.pi / 4 for place in range(8)]
    ahead = [0.4 if abs(math.remainder(angle, 2 * math.pi)) < 0.1 else 9.0 for angle in places]
    behind = [0.4 if abs(math.remainder(angle, 2 * math.pi)) > 3 else 9.0 for angle in places]
    guard.tell("by", scan(ahead, start), 1)
    assert guard.drive(twist(1.0), 2)[0] < 0.3 and guard.drive(twist(-1.0), 3)[0] == -1
    guard.tell("by", scan(behind, start), 4)
    assert guard.drive(twist(1.0), 5)[0] == 1
    guard.got.clear()
    guard.tell("by", scan(ahead, start), 6)
    assert [legs_of(data)[0] for _at, data in guard.got] == [0]


def test_a_blind_or_silent_scanner_stops() -> None:
    for ranges in ([], [math.nan] * 4, [0.0] * 4, [11.0] * 4):
        guard = Guarded("separation")
        guard.tell("by", scan(ranges), 1)
        assert guard.drive(twist(0.1), 2)[0] == 0
    guard = Guarded("separation")
    guard.tell("by", scan([math.inf] * 4), 1)
    assert guard.drive(twist(0.1), 400)[0] == 0.1
    guard.advance(520)
    assert legs_of(guard.got[-1][1])[0] == 0
