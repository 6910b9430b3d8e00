from pathlib import Path

import pytest
from rosbags.rosbag2.storage_mcap import McapReader

from appliance.features.recorder.bag_writer import BagMessage, BagWriter
from appliance.features.recorder.mcap import as_mcap
from tests.unit.features.recorder.test_bag_writer import HEADER, SECOND, body


def read(path: Path, bag: Path) -> tuple[list[tuple[str, str, int]], list[tuple[str, int, bytes]]]:
    """Read the file as ROS 2, because `rosbags` accepts no other MCAP. Everything else is the same for both."""
    path.write_bytes(b"".join(as_mcap(bag)).replace(b"ros1", b"ros2"))
    reader = McapReader(path)
    reader.open()
    try:
        connections = [(one.topic, one.msgtype, one.msgcount) for one in reader.connections]
        found = [(one.topic, time, bytes(data)) for one, time, data in reader.messages(reader.connections)]
        assert all(schema.encoding == "ros2msg" for schema in reader.schemas.values())
        assert all(channel.message_encoding == "ros2" for channel in reader.channels.values())
        assert all(b"host\x08\0\0\x0010.0.0.1" in channel.metadata for channel in reader.channels.values())
        return connections, found
    finally:
        reader.close()


@pytest.mark.parametrize("size", [5, 600_000])
def test_another_library_reads_it(tmp_path: Path, size: int) -> None:
    bag = BagWriter(tmp_path / "a.bag", {})
    first, second = bag.connect(HEADER), bag.connect(HEADER | {"callerid": "/other"})
    third = bag.connect(HEADER | {"topic": "/quiet", "type": "std_msgs/Empty", "message_definition": "\n"})
    messages = [
        BagMessage([first, second, third][number % 3], number * SECOND + 7, body(bytes([number]) * size))
        for number in range(9)
    ]
    bag.write(reversed(messages))
    bag.close()
    connections, found = read(tmp_path / "a.mcap", tmp_path / "a.bag")
    assert [(topic, kind.replace("/msg/", "/"), count) for topic, kind, count in connections] == [
        ("/chatter", "std_msgs/String", 3),
        ("/chatter", "std_msgs/String", 3),
        ("/quiet", "std_msgs/Empty", 3),
    ]
    topics = ["/chatter", "/chatter", "/quiet"]
    assert found == [(topics[number % 3], one.time, one.body) for number, one in enumerate(messages)]


def test_a_bag_without_messages_is_a_valid_file(tmp_path: Path) -> None:
    BagWriter(tmp_path / "a.bag", {}).close()
    assert read(tmp_path / "a.mcap", tmp_path / "a.bag") == ([], [])


def test_a_file_that_is_not_a_bag_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_text("no bag")
    with pytest.raises(ValueError, match="not a bag"):
        next(as_mcap(tmp_path / "a.bag"))
