from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from examples.landshark.drive import Part, Simulation, record
from examples.landshark.messages import Messages

SHORT = (Part(0.5, tilt=0.2), Part(1.0, forward=1.0), Part(0.5, fire=True))


def test_two_drives_are_equal() -> None:
    assert Simulation().run(SHORT).messages == Simulation().run(SHORT).messages


def test_the_base_stops_without_commands() -> None:
    drive = Simulation().run(SHORT)
    assert drive.poses[-1].x == pytest.approx(1.0, abs=0.11)
    assert [shot.fired for shot in drive.shots] == [True]


def test_the_recording_has_every_message_in_order(tmp_path: Path) -> None:
    drive = Simulation().run(SHORT)
    record(drive, tmp_path / "drive.bag")
    with Reader(tmp_path / "drive.bag") as reader:
        found = [(time, connection.topic, data) for connection, time, data in reader.messages()]
        definitions = {connection.topic: connection.msgdef.data for connection in reader.connections}
    assert found == [(message.time, message.topic, message.data) for message in drive.messages]
    assert "uint8 SINGLE_SHOT" in definitions["/landshark_control/trigger"]
    with pytest.raises(FileExistsError):
        record(drive, tmp_path / "drive.bag")


def test_missing_fields_are_zero() -> None:
    messages = Messages()
    data = messages.encode("nav_msgs/Odometry", pose__pose__position={"x": 2.0}, child_frame_id="base_link")
    odometry = messages.decode("nav_msgs/Odometry", data)
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (2.0, 0.0)
    assert odometry.child_frame_id == "base_link"
    assert not odometry.pose.covariance.any()
