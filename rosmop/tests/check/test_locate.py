"""A bound parameter equals the decoded field, and changing it equals encoding the whole changed message."""

import struct
from collections.abc import Iterator
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, load, message
from rosmop.tests.examples import examples
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from roswire.definitions import Definitions

KINDS = (
    "nav_msgs/Odometry", "sensor_msgs/JointState", "sensor_msgs/LaserScan", "nav_msgs/Path", "sensor_msgs/PointCloud2",
    "sensor_msgs/CameraInfo", "trajectory_msgs/JointTrajectory", "diagnostic_msgs/DiagnosticArray", "sensor_msgs/Imu",
    "visualization_msgs/Marker", "nav_msgs/OccupancyGrid", "geometry_msgs/PolygonStamped",
    "sensor_msgs/MultiDOFJointState",
    "std_msgs/UInt8MultiArray", "geometry_msgs/PoseWithCovarianceStamped", "sensor_msgs/NavSatFix",
)  # fmt: skip


def content(random: Random, kind: value_types.Type) -> object:
    if isinstance(kind, value_types.RecordType):
        slots = MessageTypes(definitions()).slots(kind.name)
        return {name: content(random, slot.type) for name, slot in slots.items()}
    if isinstance(kind, value_types.VectorType):
        count = random.randrange(4) if kind.length is None else kind.length
        return [content(random, kind.element) for _ in range(count)]
    if isinstance(kind, value_types.IntegerType):
        return random.randint(kind.least, kind.most)
    if isinstance(kind, value_types.TimeType | value_types.DurationType):
        return {"sec": random.randrange(2**31), "nanosec": random.randrange(10**9)}
    if isinstance(kind, value_types.BoolType):
        return random.random() < 0.5
    return (
        "x" * random.randrange(6)
        if isinstance(kind, value_types.StringType)
        else float(random.randrange(-99, 99)) / 4
    )


def paths(kind: value_types.Type, value: object, path: str = "") -> Iterator[tuple[str, value_types.Type]]:
    if path:
        yield path, kind
    if isinstance(kind, value_types.RecordType) and isinstance(value, dict):
        for name, slot in MessageTypes(definitions()).slots(kind.name).items():
            yield from paths(slot.type, value[name], f"{path}.{name}" if path else name)
    if isinstance(kind, value_types.VectorType) and isinstance(value, list):
        for index in range(min(len(value), 3)):
            yield from paths(kind.element, value[index], f"{path}[{index}]")


def change(kind: value_types.Type, name: str) -> str:
    if isinstance(kind, value_types.StringType):
        return f'{name} += "longer";'
    if isinstance(kind, value_types.BoolType):
        return f"{name} = !{name};"
    if isinstance(kind, value_types.VectorType) and kind.length is None:
        return f"{name}.resize(5);"
    if isinstance(kind, value_types.TimeType | value_types.DurationType):
        return f"{name}.nsec = 17;"
    return f"{name} = 7;" if value_types.is_number(kind) else ""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(examples(6)))
def test_every_field_of_a_random_message(kind: str, seed: int) -> None:
    random = Random(f"{kind} {seed}")  # noqa: S311  draws examples, not keys
    value = content(random, value_types.RecordType(kind))
    data = _encoded(kind, value)
    found = list(paths(value_types.RecordType(kind), value))
    for path, field in random.sample(found, min(len(found), 25)):
        text = f"""s() {{ {kind} v; event e(auto p) /t {kind} '{{{path}:p}}' {{
            v = MESSAGE; ROS_INFO("%d", p == v.{path});
            {change(field, f"v.{path}")} {change(field, "p")} PUBLISH(/whole, {kind}, v); }} }}"""
        outcome = load(text).process("/t", data, 0)
        assert not outcome.faults, (path, outcome.faults)
        assert [line.text for line in outcome.log] == ["1"], path
        assert outcome.published[0].data == bytes(outcome.buffer), path


def _encoded(kind: str, value: object) -> bytes:
    assert isinstance(value, dict)
    return message(kind, **value)


def test_an_array_behind_a_large_one_and_a_string_is_not_the_array_before_them() -> None:
    pad = 2_000_000
    own = {"own/Large.msg": f"int8[{pad}] pad\nint32[2] x\nstring s\nint32[2] y\n"}
    text = "s() { event e(int a, int b) /t own/Large '{x[0]:a, y[0]:b}' { ROS_INFO(\"%d %d\", a, b); } }"
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions().merge(Definitions.from_files(own))))
    monitors.start(0)
    data = bytes(pad) + struct.pack("<iiI3sii", 11, 12, 3, b"abc", 21, 22)
    assert [line.text for line in monitors.process("/t", data, 0).log] == ["11 21"]
