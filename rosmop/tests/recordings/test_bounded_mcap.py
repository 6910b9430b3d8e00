import random
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from rosmop.recordings import bounded_mcap, regular_files
from rosmop.recordings.recording import RecordedFile, RecordingError


def make_mcap(
    path: Path,
    rows: Sequence[tuple[int, bytes]],
    *,
    encoding: str = "ros1",
    **options: Any,
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 200, "compression": CompressionType.NONE, **options})
        writer.start(profile="ros1")
        schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
        channel = writer.register_channel("/t", encoding, schema)
        for time, data in rows:
            writer.add_message(channel, time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap has no type for it
    return path


def refusal(path: Path) -> str:
    with pytest.raises(RecordingError) as ended:
        list(RecordedFile(path, ["*"]).messages())
    return str(ended.value)


def test_messages_are_in_the_order_of_time(tmp_path: Path) -> None:
    chance = random.Random(1)  # noqa: S311  no secret
    rows = [(number // 20 * 10 + chance.randrange(40), str(number).encode()) for number in range(500)]
    messages = list(RecordedFile(make_mcap(tmp_path / "x.mcap", rows), ["*"]).messages())
    assert [(time, data) for _topic, time, data in messages] == sorted(rows, key=lambda row: row[0])


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_is_unpacked_up_to_a_limit(
    compression: CompressionType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_mcap(tmp_path / "x.mcap", [(1, bytes(100_000))], chunk_size=200_000, compression=compression)
    assert len(next(RecordedFile(path, ["*"]).messages())[2]) == 100_000
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", 50_000)
    reason = "exceeds limit 50000" if compression is CompressionType.NONE else "more than 50000 bytes"
    assert reason in refusal(path)


def test_chunks_of_one_time_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [(time, bytes(1000)) for _chunk in range(40) for time in (1, 1000)]
    path = make_mcap(tmp_path / "x.mcap", rows, chunk_size=1500)
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", 20_000)
    assert "sort the file by time" in refusal(path)


def test_repeated_reading_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [(time, bytes(10_000)) for time in range(50)]
    path = make_mcap(tmp_path / "x.mcap", rows, chunk_size=20_000, compression=CompressionType.ZSTD)
    monkeypatch.setattr(regular_files, "LARGEST_CHUNK", 50_000)
    monkeypatch.setattr(bounded_mcap, "PER_BYTE", 1)
    assert "unpacks to more than 1 times its size" in refusal(path)


def test_other_files_are_named(tmp_path: Path) -> None:
    rows = [(1, b"x")]
    assert "only of encoding cdr" in refusal(make_mcap(tmp_path / "2.mcap", rows, encoding="cdr"))
    whole = make_mcap(tmp_path / "1.mcap", rows).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:-20])
    assert "cannot read the MCAP file" in refusal(tmp_path / "cut.mcap")
    assert "has no messages" in refusal(make_mcap(tmp_path / "0.mcap", []))


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("chunk_size", [1, 200, 10**6]),
        ("compression", list(CompressionType)),
        ("index_types", [IndexType.NONE, *IndexType, IndexType.ALL]),
        *((f"repeat_{part}", [False]) for part in ("channels", "schemas")),
        *((f"use_{part}", [False]) for part in ("chunking", "statistics", "summary_offsets")),
        *((f"enable_{part}", [False, True]) for part in ("crcs", "data_crcs")),
    ],
)
def test_each_writer_s_messages_are_read_or_the_file_is_refused(
    option: str, values: Sequence[Any], tmp_path: Path
) -> None:
    rows = [(time, bytes(20)) for time in range(1, 60)]
    others: list[dict[str, Any]] = [
        {},
        {"use_statistics": False},
        {"repeat_schemas": False},
        {"use_chunking": False},
    ]
    for count, value, other in product((0, len(rows)), values, others):
        path = make_mcap(tmp_path / "x.mcap", rows[:count], **{**other, option: value})
        try:
            assert [row[1:] for row in RecordedFile(path, ["*"]).messages()] == rows[:count]
        except RecordingError as error:
            assert "`mcap recover`" in str(error) or (not count and "has no messages" in str(error))


def test_damage_gives_messages_or_the_reason(tmp_path: Path) -> None:
    rows = [(time, bytes([time]) * 30) for time in range(60)]
    chance, ended = random.Random(5), 0  # noqa: S311  the same each time
    for compression in CompressionType:
        whole = make_mcap(tmp_path / "whole.mcap", rows, compression=compression).read_bytes()
        for _turn in range(150):
            data = bytearray(whole)
            for _byte in range(3):
                data[chance.randrange(9, len(data))] = chance.randrange(256)
            (tmp_path / "damaged.mcap").write_bytes(data)
            try:
                list(RecordedFile(tmp_path / "damaged.mcap", ["*"]).messages())
            except RecordingError:
                ended += 1
    assert ended > 50
