# ruff: noqa: E501  the rows of tables

import struct

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import STORE, definitions, load, message
from roswire.definitions import Definitions


def event(kind: str, parameters: str, pattern: str, body: str, rest: str = "") -> str:
    return f"s() {{ {rest} event e({parameters}) /t {kind} '{{{pattern}}}' {{ {body} }} }}"


def process(text: str, data: bytes | bytearray) -> Outcome:
    return load(text).process("/t", data, 10**9)


JOINTS = message(
    "sensor_msgs/JointState", header__seq=7, header__stamp__sec=3, header__stamp__nanosec=5, header__frame_id="base",
    name=["turret_pan", "turret_tilt"], position=[0.5, -0.25], velocity=[], effort=[1.0, 2.0, 3.0],
)  # fmt: skip


def test_a_float_constant_of_a_message_is_a_float() -> None:
    own = definitions().merge(Definitions.from_files({"own/C.msg": "float32 LIMIT=0.1\nfloat32 x\n"}))
    text = event(
        "own/C", "float x", "x:x", 'ROS_INFO("%d %d", x == own::C::LIMIT, (double) own::C::LIMIT == 0.1);'
    )
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, own))
    monitors.start(0)
    assert [line.text for line in monitors.process("/t", struct.pack("<f", 0.1), 1).log] == ["1 0"]


UINT8S, INT8S = "std_msgs/UInt8MultiArray", "std_msgs/Int8MultiArray"


def test_a_change_of_fixed_size_is_made_in_place() -> None:
    buffer = bytearray(message("std_msgs/Int32", data=1))
    assert process(event("std_msgs/Int32", "int x", "data:x", "x = 2;"), buffer).buffer is buffer
    assert buffer == message("std_msgs/Int32", data=2)


def test_a_writable_view_is_changed_in_place_and_a_readonly_one_is_not() -> None:
    text = event("std_msgs/Int32", "int x", "data:x", "x = 2;")
    received = bytearray(b"??" + message("std_msgs/Int32", data=1))
    outcome = load(text).process("/t", memoryview(received)[2:], 0)
    assert bytes(received) == b"??" + bytes(outcome.buffer) == b"??" + message("std_msgs/Int32", data=2)
    readonly = memoryview(message("std_msgs/Int32", data=1))
    assert bytes(load(text).process("/t", readonly, 0).buffer) == message("std_msgs/Int32", data=2)
    assert bytes(readonly) == message("std_msgs/Int32", data=1)


SIMPLE_TYPES = sorted(
    name.replace("/msg/", "/")
    for name in STORE.fielddefs
    if name.split("/")[0] in ("geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "diagnostic_msgs", "trajectory_msgs")
)  # fmt: skip


@pytest.mark.parametrize("kind", SIMPLE_TYPES)
def test_a_message_survives_a_copy_and_a_publish(kind: str) -> None:
    data = message(kind)
    text = event(kind, "", "", f"v = MESSAGE; PUBLISH(/copy, {kind}, v);", f"{kind} v;")
    outcome = process(text, data)
    assert not outcome.faults
    assert [(each.topic, each.type, each.data) for each in outcome.published] == [("/copy", kind, data)]


@pytest.mark.parametrize(
    "kind", ["sensor_msgs/JointState", "nav_msgs/Odometry", "sensor_msgs/LaserScan", "nav_msgs/Path"]
)
def test_a_message_with_content_survives(kind: str) -> None:
    given: dict[str, dict[str, object]] = {
        "sensor_msgs/JointState": {"name": ["a", "", "ccc"], "position": [1.5, float("inf")], "header__frame_id": "x"},
        "nav_msgs/Odometry": {"child_frame_id": "b", "pose__covariance": [float(i) for i in range(36)], "header__stamp__sec": 4},
        "sensor_msgs/LaserScan": {"ranges": [0.5, 1.5, 2.5], "angle_min": -1.0},
        "nav_msgs/Path": {"poses": [{"header": {"frame_id": "one"}}, {"header": {"frame_id": "two"}, "pose": {"position": {"x": 5.0}}}]},
    }  # fmt: skip
    data = message(kind, **given[kind])
    outcome = process(event(kind, "", "", f"v = MESSAGE; PUBLISH(/copy, {kind}, v);", f"{kind} v;"), data)
    assert [each.data for each in outcome.published] == [data]


@pytest.mark.parametrize("length", range(len(JOINTS)))
def test_a_message_that_is_cut_short_is_a_fault(length: int) -> None:
    text = event("sensor_msgs/JointState", "double[] e", "effort:e", "double y = e[0];")
    outcome = process(text, JOINTS[:length])
    assert (outcome.result, len(outcome.faults)) == ("dropped", 1)
