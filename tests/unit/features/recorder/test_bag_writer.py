from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from appliance.features.recorder.bag_writer import (
    MESSAGE_SIZE,
    BagMessage,
    BagWriter,
    chunk_size,
    connection_size,
)

HEADER = {
    "topic": "/chatter", "type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
    "message_definition": "string data\n", "callerid": "/talker", "host": "10.0.0.1",
}  # fmt: skip
SECOND = 1_000_000_000


def body(text: bytes) -> bytes:
    return len(text).to_bytes(4, "little") + text


def read(path: Path) -> list[tuple[str, int, bytes]]:
    with Reader(path) as reader:
        return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]


def test_read_by_rosbags(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "a.bag", {})
    chatter, other = bag.connect(HEADER), bag.connect(HEADER | {"topic": "/other"})
    bag.write([BagMessage(chatter, 5 * SECOND + 3, body(b"late")), BagMessage(other, SECOND, body(b"first"))])
    bag.write([])
    bag.write([BagMessage(chatter, 2 * SECOND, memoryview(body(b"second")))])
    bag.close()
    assert read(tmp_path / "a.bag") == [
        ("/other", SECOND, body(b"first")),
        ("/chatter", 2 * SECOND, body(b"second")),
        ("/chatter", 5 * SECOND + 3, body(b"late")),
    ]


@pytest.mark.parametrize("torn", [0, 1, 50, 200])
def test_another_writer_continues_a_bag(tmp_path: Path, torn: int) -> None:
    path = tmp_path / "left.bag"
    bag = BagWriter(tmp_path / "a.bag", {})
    size = bag.write([BagMessage(bag.connect(HEADER), SECOND, body(b"one"))])
    path.write_bytes((tmp_path / "a.bag").read_bytes() + bytes(torn))
    bag.close()
    bag = BagWriter(path, {0: HEADER}, size)
    bag.write(
        [BagMessage(0, 2 * SECOND, body(b"two")), BagMessage(bag.connect(HEADER), 3 * SECOND, body(b"three"))]
    )
    size = bag.closed_size
    bag.write([BagMessage(0, 4 * SECOND, body(b"four"))])
    size += chunk_size(HEADER) - connection_size(HEADER) + MESSAGE_SIZE + len(body(b"four"))
    assert bag.closed_size == size
    bag.close()
    assert path.stat().st_size == size
    assert [data for _topic, _time, data in read(path)] == [
        body(text) for text in (b"one", b"two", b"three", b"four")
    ]


def test_data_lost_in_a_power_cut_is_left_out_and_reported(tmp_path: Path) -> None:
    path, whole = tmp_path / "cut.bag", tmp_path / "whole.bag"
    headers = [HEADER, HEADER | {"topic": "/other"}]
    bag = BagWriter(whole, {})
    numbers = [bag.connect(header) for header in headers]
    sizes = [
        bag.write([BagMessage(number, (2 * chunk + number) * SECOND, body(b"x")) for number in numbers])
        for chunk in range(3)
    ]
    bag.leave()
    data = whole.read_bytes()
    for length in [0, 20, *range(sizes[0] - 300, len(data), 5), *sizes]:
        path.write_bytes(data[:length])
        bag = BagWriter(path, dict(enumerate(headers)), sizes[-1])
        assert bag.lost is (length < len(data))
        bag.write([BagMessage(0, 9 * SECOND, body(b"y"))])
        bag.close()
        times = [time // SECOND for _topic, time, _data in read(path)]
        assert times == [*range(len(times) - 1), 9]
        assert len(times) % 2
        assert len(times) // 2 >= sum(size <= length for size in sizes) - bag.lost
    path.unlink()
    bag = BagWriter(path, {}, sizes[-1])
    assert bag.lost
    bag.close()


def test_stock_tools_find_beginning_and_end(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "a.bag", {})
    chatter = bag.connect(HEADER)
    for times in ((5, 9), (3, 4), (7, 8)):
        bag.write([BagMessage(chatter, time * SECOND, body(b"x")) for time in times])
    bag.close()
    with Reader(tmp_path / "a.bag") as reader:
        chunks = [(info.start_time, info.end_time) for info in reader.chunk_infos]
    assert [(first, last - 1) for first, last in chunks] == [
        (number * SECOND, end * SECOND) for number, end in ((3, 4), (7, 8), (5, 9))
    ]
    assert [time for _topic, time, _data in read(tmp_path / "a.bag")] == [
        number * SECOND for number in (3, 4, 5, 7, 8, 9)
    ]


def test_empty_bag(tmp_path: Path) -> None:
    BagWriter(tmp_path / "a.bag", {}).close()
    assert read(tmp_path / "a.bag") == []
