"""The functions of the library. `rosmop/tests/programs.txt` compares them in the module with the interpreter."""

import math
import struct
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from random import Random

import pytest

from rosmop.runtime import numbers
from rosmop.runtime.action_context import BUDGET
from rosmop.tests.acting import load, message
from rosmop.tests.examples import examples

RANDOM = Random(7)  # noqa: S311  draws examples, not keys
SPECIAL = (0.0, -0.0, 1.0, -1.0, 5e-324, -1e-310, 1e308, math.inf, -math.inf, math.nan)
POLYGON = ((-2, -2), (2, -2), (0.5, 0), (2, 2), (0, 3), (-2, 2))
CORNERS = ", ".join(f"{x}, {y}" for x, y in POLYGON)


def called(expression: str, kind: str = "double") -> Callable[..., object]:
    monitors = load(f"""s() {{ const double P[] = {{{CORNERS}}}; {kind} r;
        event e(double x, double y, double z) /v geometry_msgs/Vector3 '{{x:x, y:y, z:z}}' {{
            r = {expression}; }} }}""")

    def call(x: float, y: float = 0.0, z: float = 0.0) -> object:
        assert not monitors.process("/v", bytearray(struct.pack("<3d", x, y, z)), 1).faults
        return monitors.value("s", "r")

    return call


def test_clamp_maps_nan_to_the_allowed_value_nearest_to_zero() -> None:
    clamp = called("clamp(x, y, z)")
    for low, high in ((-1.0, 2.0), (0.5, 2.0), (-3.0, -1.5), (0.0, 0.0)):
        assert clamp(math.nan, low, high) == min(max(0.0, low), high)
        for value in SPECIAL[:-1]:
            assert clamp(value, low, high) == min(max(value, low), high)
    for x in SPECIAL:
        for low in SPECIAL[:-1]:
            assert not math.isnan(clamp(x, low, math.nan))  # type: ignore[arg-type]  # a number
            assert not math.isnan(clamp(x, math.nan, low))  # type: ignore[arg-type]  # as above


def winding(x: Fraction, y: Fraction) -> int:
    number = 0
    for (ax, ay), (bx, by) in pairwise((*POLYGON, POLYGON[0])):
        left = (bx - ax) * (y - ay) - (x - ax) * (by - ay)
        number += (ay <= y < by and left > 0) - (by <= y < ay and left < 0)
    return number


def test_inside_is_the_winding_number() -> None:
    inside, distance = called("inside(x, y, P)", "bool"), called("distance(x, y, P)")
    for _ in range(examples(1200)):
        x, y = (RANDOM.choice((RANDOM.uniform(-4, 4), RANDOM.randrange(-4, 5))) for _ in range(2))
        near = min(
            math.dist((x, y), (ax + t * (bx - ax), ay + t * (by - ay)))
            for (ax, ay), (bx, by) in pairwise((*POLYGON, POLYGON[0]))
            for t in [
                max(
                    0.0,
                    min(
                        1.0,
                        ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / math.dist((ax, ay), (bx, by)) ** 2,
                    ),
                )
            ]
        )
        assert math.isclose(distance(x, y), near, abs_tol=1e-9)  # type: ignore[arg-type]  # a number
        if near > 1e-6:
            assert inside(x, y) == (winding(Fraction(x), Fraction(y)) != 0)
    for odd in (math.nan, math.inf, -math.inf):
        assert not inside(odd, 0)
        assert not inside(0, odd)
        assert distance(odd, 0) == distance(0, odd) == 0


def test_yaw_is_the_angle_of_any_multiple_of_a_quaternion() -> None:
    monitors = load("""s() { double r; event e(geometry_msgs::Quaternion q) /q geometry_msgs/PoseStamped
        '{pose.orientation:q}' { r = yaw(q); } }""")
    for _ in range(examples(240)):
        angle, size = RANDOM.uniform(-3.1, 3.1), RANDOM.uniform(0.1, 9)
        body = message(
            "geometry_msgs/PoseStamped",
            pose__orientation__z=size * math.sin(angle / 2),
            pose__orientation__w=size * math.cos(angle / 2),
        )
        monitors.process("/q", bytearray(body), 1)
        assert math.isclose(monitors.value("s", "r"), angle, abs_tol=1e-12)


def ecef(lat: float, lon: float) -> tuple[float, float, float]:
    lat, lon = math.radians(lat), math.radians(lon)
    n = 6378137 / math.sqrt(1 - 0.00669437999014 * math.sin(lat) ** 2)
    flat = n * math.cos(lat)
    return flat * math.cos(lon), flat * math.sin(lon), n * (1 - 0.00669437999014) * math.sin(lat)


@pytest.mark.parametrize(("lat", "lon"), [(0, 0), (48.1, 11.6), (-33.9, 151.2), (60.0, 179.999)])
def test_metres_are_those_of_the_ellipsoid(lat: float, lon: float) -> None:
    ways = [called(f"metres_{way}(x, y, {lat}, {lon})") for way in ("east", "north")]
    for _ in range(examples(600)):
        there = lat + RANDOM.uniform(-0.006, 0.006), lon + RANDOM.uniform(-0.006, 0.006)
        wrapped = there[0], there[1] - 360 if there[1] > 180 else there[1]
        east, north = (metres(*wrapped) for metres in ways)
        d = [a - b for a, b in zip(ecef(*there), ecef(lat, lon), strict=True)]
        s, c = math.sin(math.radians(lon)), math.cos(math.radians(lon))
        sl, cl = math.sin(math.radians(lat)), math.cos(math.radians(lat))
        assert abs(east - (c * d[1] - s * d[0])) < 0.3  # type: ignore[operator]  # a number
        assert abs(north - (cl * d[2] - sl * (c * d[0] + s * d[1]))) < 0.3  # type: ignore[operator]  # as above


def test_nearest_ignores_nan_and_wraps() -> None:
    monitors = load("""s() { double r; long first; long last;
        event from(long i) /from std_msgs/Int64 '{data:i}' { first = i; }
        event to(long i) /to std_msgs/Int64 '{data:i}' { last = i; }
        event e(float[] v) /v std_msgs/Float32MultiArray '{data:v}' { r = nearest(v, first, last); } }""")
    for _ in range(examples(300)):
        values = [
            RANDOM.choice((*SPECIAL[:4], 0.25, 7.0, math.inf, math.nan)) for _ in range(RANDOM.randrange(6))
        ]
        first, last = RANDOM.randrange(-2, 8), RANDOM.randrange(-2, 8)
        begin, end = (min(max(0, limit), len(values)) for limit in (first, last))
        chosen = values[begin:end] if begin <= end else values[begin:] + values[:end]
        for topic, kind, data in (
            ("/from", "Int64", first), ("/to", "Int64", last), ("/v", "Float32MultiArray", values)
        ):  # fmt: skip
            monitors.process(topic, bytearray(message(f"std_msgs/{kind}", data=data)), 1)
        assert monitors.value("s", "r") == min((v for v in chosen if not math.isnan(v)), default=math.inf)


def test_a_scan_of_400_000_ranges_is_searched_within_the_budget() -> None:
    monitors = load(
        "s() { double r; event e(float[] v) /v std_msgs/Float32MultiArray '{data:v}' { r = nearest(v, 0, v.size()); } }"
    )
    body = message("std_msgs/Float32MultiArray", data=[5.0] * 399_999 + [0.5])
    assert not monitors.process("/v", bytearray(body), 1).faults
    assert monitors.value("s", "r") == 0.5
    assert BUDGET - 430_000 < monitors.monitor("s").context.budget < BUDGET - 400_000


def test_isfinite_of_a_message_covers_all_its_numbers() -> None:
    monitors = load("""s() { bool r; event e(trajectory_msgs::JointTrajectoryPoint[] p) /t
        trajectory_msgs/JointTrajectory '{points:p}' { r = isfinite(p) && isfinite(MESSAGE); } }""")
    kind = "trajectory_msgs/JointTrajectory"
    for bad in (None, math.nan, math.inf):
        for where in ("positions", "effort"):
            points = [{"positions": [1.0], "effort": []}, {"positions": [2.0], "effort": [3.0]}]
            if bad is not None:
                points[1][where][-1] = bad
            body = message(kind, points=points)
            monitors.process("/t", bytearray(body), 1)
            assert monitors.value("s", "r") == (bad is None)


def error(value: float, other: float) -> float:
    if value == other or (math.isnan(value) and math.isnan(other)):
        return 0 if math.copysign(1, value) == math.copysign(1, other) or math.isnan(value) else math.inf
    return abs(value - other) / math.ulp(other)


@pytest.mark.parametrize("name", ["sin", "cos", "atan2", "hypot"])
def test_elementary_functions_are_exact_to_the_last_place(name: str) -> None:
    ours, theirs = getattr(numbers, name), getattr(math, name)
    two = name in {"atan2", "hypot"}
    for x in SPECIAL:
        for y in SPECIAL if two else (0.0,):
            if two or math.isfinite(x):
                assert error(ours(*(x, y)[: 1 + two]), theirs(*(x, y)[: 1 + two])) <= (0 if two else 1)
    for number in range(examples(60_000)):
        size = 10 ** RANDOM.uniform(-8, 6 if number % 2 else 1)
        given = [RANDOM.uniform(-1, 1) * size for _ in range(1 + two)]
        if not two and number % 5 == 0:
            given = [math.pi / 2 * RANDOM.randrange(600_000)]  # where digits cancel
        assert error(ours(*given), theirs(*given)) <= 1
