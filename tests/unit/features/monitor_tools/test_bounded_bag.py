import bz2
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest

from rosmop.recordings import bounded_bag, regular_files
from rosmop.recordings.recording import RecordedFile, RecordingError
from tests.support.bags import make_bag, number
from tests.support.command import rosrv

Part = tuple[dict[str, bytes], bytes]
U32, U64 = struct.Struct("<I").pack, struct.Struct("<Q").pack
CONNECTION: Part = (
    {"op": b"\x07", "conn": U32(0), "topic": b"/t"},
    b"".join(
        U32(len(field)) + field
        for field in (b"topic=/t", b"type=std_msgs/String", b"md5sum=992ce8a1687cec8c8bd883ec73ca41d1",
                      b"message_definition=string data\n")
    ),
)  # fmt: skip


def record(fields: dict[str, bytes], data: bytes) -> bytes:
    header = b"".join(
        U32(len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items()
    )
    return U32(len(header)) + header + U32(len(data)) + data


def bag(path: Path, chunks: list[tuple[str, bytes, list[tuple[int, int]]]]) -> Path:
    out = bytearray(b"#ROSBAG V2.0\n" + bytes(4096))
    infos = b""
    for compression, packed, entries in chunks:
        infos += record(
            {"op": b"\x06", "ver": U32(1), "chunk_pos": U64(len(out)), "start_time": U64(entries[0][0]),
             "end_time": U64(entries[-1][0]), "count": U32(1)}, U32(0) + U32(len(entries)),
        )  # fmt: skip
        out += record({"op": b"\x05", "compression": compression.encode(), "size": U32(1)}, packed)
        index = b"".join(U32(seconds) + U32(0) + U32(offset) for seconds, offset in entries)
        out += record({"op": b"\x04", "ver": U32(1), "conn": U32(0), "count": U32(len(entries))}, index)
    head = record(
        {"op": b"\x03", "index_pos": U64(len(out)), "conn_count": U32(1), "chunk_count": U32(len(chunks))},
        b"",
    )
    out[13 : 13 + len(head)] = head
    path.write_bytes(bytes(out) + record(*CONNECTION) + infos)
    return path


def message(seconds: int, text: bytes) -> bytes:
    return record({"op": b"\x02", "conn": U32(0), "time": U64(seconds)}, U32(len(text)) + text)


def refusal(path: Path) -> str:
    with pytest.raises(RecordingError) as ended:
        list(RecordedFile(path, ["*"]).messages())
    return str(ended.value)


@pytest.mark.parametrize(
    ("name", "pack"), [("bz2", bz2.compress), ("lz4", lz4.frame.compress), ("none", bytes)]
)
def test_a_chunk_is_unpacked_up_to_a_limit(
    name: str, pack: Callable[[bytes], bytes], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    one = message(1, b"x" * 1000)
    path = bag(tmp_path / "x.bag", [(name, pack(one), [(1, 0)])])
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", len(one))
    assert [data for _topic, _time, data in RecordedFile(path, ["*"]).messages()] == [U32(1000) + b"x" * 1000]
    path = bag(tmp_path / "x.bag", [(name, pack(message(1, bytes(2000))), [(1, 0)])])
    assert f"more than {len(one)} bytes" in refusal(path)


@pytest.mark.parametrize(("name", "pack"), [("bz2", bz2.compress), ("lz4", lz4.frame.compress)])
def test_a_damaged_chunk_is_reported(name: str, pack: Callable[[bytes], bytes], tmp_path: Path) -> None:
    packed = pack(message(1, b"x" * 1000))
    for wrong in (packed[:-4], b"?" * 50, b"", packed[:20] + b"?" * 20 + packed[40:]):
        assert "is damaged" in refusal(bag(tmp_path / "x.bag", [(name, wrong, [(1, 0)])]))


def test_repeated_reading_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", 1 << 20)
    monkeypatch.setattr(bounded_bag, "PER_BYTE", 4)
    large = bz2.compress(message(0, b"") * 1 + bytes(1 << 17))
    turns = [("bz2", large, [(0, 0)] * 40), ("bz2", large, [(0, 0)] * 40)]
    assert RecordedFile(bag(tmp_path / "x.bag", turns), ["*"]).message_count == 80
    path = bag(tmp_path / "one.bag", [("none", message(1, bytes(1 << 17)), [(1, 0)] * 100)])
    assert "more than 4 times its size" in refusal(path)
    chain = record(*CONNECTION)
    offsets = [(1, number * len(chain)) for number in range(500)]
    links = bag(tmp_path / "links.bag", [("none", chain * 500 + message(1, b""), offsets)])
    assert "more than 4 times its size" in refusal(links)
    between = [
        ("bz2", bz2.compress(message(time, b"") * 2 + bytes(1 << 17)), [(time, 0)]) for time in range(20)
    ]
    twice = [(name, packed, [entries[0], (entries[0][0] + 1, 0)]) for name, packed, entries in between]
    assert "damaged" in refusal(bag(tmp_path / "turns.bag", twice))


@pytest.mark.parametrize(("name", "pack"), [("bz2", bz2.compress), ("none", bytes)])
def test_chunks_of_the_same_time_are_unpacked_once(
    name: str, pack: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", 1 << 17)
    monkeypatch.setattr(bounded_bag, "PER_BYTE", 2 if name == "none" else 60)
    chunks = []
    for stream in range(3):
        times = range(stream, 300, 3)
        records = [message(time, bytes(100)) for time in times]
        offsets = [number * len(records[0]) for number in range(100)]
        chunks.append((name, pack(b"".join(records)), list(zip(times, offsets, strict=True))))
    found = RecordedFile(bag(tmp_path / "x.bag", chunks), ["*"]).messages()
    assert [time for _topic, time, _data in found] == [second * 10**9 for second in range(300)]


def test_chunks_cannot_share_an_index(tmp_path: Path) -> None:
    path = bag(tmp_path / "x.bag", [("none", message(1, b""), [(1, 0)] * 1000)])
    data = path.read_bytes()
    info = data[data.index(record(*CONNECTION)) + len(record(*CONNECTION)) :]
    path.write_bytes(data.replace(b"chunk_count=" + U32(1), b"chunk_count=" + U32(100)) + info * 99)
    assert "share an index" in refusal(path)


@pytest.mark.nightly
@pytest.mark.parametrize("times", [[1000.0], [1000.0, 1000.0], [1000.0, 1000.000000001], [1000.0, 1001.0]])
@pytest.mark.parametrize("share", ["0", "0.3", "0.9"])
def test_a_short_recording_is_learned_from(times: list[float], share: str, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "x.bag", [("/t", "std_msgs/Int32", time, number(1)) for time in times])
    other = shutil.copy(path, tmp_path / "other.bag")
    for arguments in (["--hold-out", share], ["--bag", str(other)]):
        result = rosrv("monitor", "learn", "--bag", str(path), *arguments)
        assert result.returncode in (0, 2), result.stderr
