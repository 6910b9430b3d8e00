import os
from pathlib import Path

import pytest

from appliance.channel.messages import StateGiven
from appliance.supervisor.monitor_memory import FOLDER, SIZE, MonitorMemory

WRITTEN = b"rosrvMS1\x01"


def given(memory: MonitorMemory, index: int) -> list[tuple[StateGiven, bytes]]:
    found = memory.messages_for("relay", index)
    return [(message, os.pread(descriptor, 16, 0)) for message, descriptor in found]


def write(memory: MonitorMemory, index: int, more: bytes = b"") -> None:
    [*_, (message, descriptor)] = memory.messages_for("relay", index)
    assert message.own
    os.pwrite(descriptor, WRITTEN + more, 0)


def test_only_relays_have_files_each_its_own(tmp_path: Path) -> None:
    """A file has its full size from the start, so no write fails later. Only root can read the folder."""
    memory = MonitorMemory(tmp_path, 2)
    assert [*memory.messages_for("control", 0)] == []
    for index in range(2):
        [(message, first)] = given(memory, index)
        assert message.own
        assert first == bytes(16)
    [life] = (tmp_path / FOLDER).iterdir()
    files = sorted(life.iterdir())
    assert [path.name for path in files] == ["relay-0", "relay-1"]
    assert {path.stat().st_blocks * 512 >= SIZE for path in files} == {True}
    assert (tmp_path / FOLDER).stat().st_mode & 0o777 == 0o700
    memory.close()


def test_every_relay_reads_the_state_of_the_last_run(tmp_path: Path) -> None:
    first = MonitorMemory(tmp_path, 2)
    write(first, 0, b"a")
    write(first, 1, b"b")
    second = MonitorMemory(tmp_path, 3)
    for index in range(3):
        *earlier, (own, empty) = given(second, index)
        assert [data[9:10] for _, data in earlier] == [b"a", b"b"]
        assert not any(message.own for message, _ in earlier)
        assert (own.ended_boot, empty) == ("", bytes(16))
    with pytest.raises(OSError):
        os.pwrite(next(second.messages_for("relay", 0))[1], b"x", 0)


def test_a_run_that_is_killed_at_its_start_loses_nothing(tmp_path: Path) -> None:
    write(MonitorMemory(tmp_path, 1), 0, b"a")
    for _ in range(3):
        memory = MonitorMemory(tmp_path, 2)
        assert [data[9:10] for _, data in given(memory, 0)] == [b"a", b"\0"]
    write(memory, 0, b"c")
    third = MonitorMemory(tmp_path, 2)
    assert [data[9:10] for _, data in given(third, 0)] == [b"a", b"c", b"\0", b"\0"]
    write(third, 0, b"d")
    write(third, 1, b"e")
    assert [data[9:10] for _, data in given(MonitorMemory(tmp_path, 1), 0)] == [b"d", b"e", b"\0"]


def test_the_files_of_short_runs_are_bounded(tmp_path: Path) -> None:
    for _ in range(10):
        write(MonitorMemory(tmp_path, 2), 0)
    assert len([*(tmp_path / FOLDER).iterdir()]) <= 5


def test_fewer_relays_drop_the_state_of_the_others(tmp_path: Path) -> None:
    first = MonitorMemory(tmp_path, 2)
    write(first, 0, b"a")
    write(first, 1, b"b")
    write(MonitorMemory(tmp_path, 1), 0, b"c")
    assert [data[9:10] for _, data in given(MonitorMemory(tmp_path, 1), 0)] == [b"c", b"\0"]


def test_an_orderly_end_is_reported_once(tmp_path: Path) -> None:
    first = MonitorMemory(tmp_path, 1)
    write(first, 0)
    boot = given(first, 0)[0][0].boot
    first.close()
    second = MonitorMemory(tmp_path, 1)
    assert given(second, 0)[-1][0].ended_boot == boot
    assert given(second, 0)[-1][0].ended_at > 0
    write(second, 0)
    assert given(MonitorMemory(tmp_path, 1), 0)[-1][0].ended_boot == ""


def test_on_a_full_disk_the_state_survives_relays_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(_descriptor: int, _offset: int, _size: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    memory = MonitorMemory(tmp_path, 2)
    write(memory, 1, b"a")
    assert given(memory, 1)[-1][1][9:10] == b"a"
    assert "do not keep their state when the appliance stops" in capsys.readouterr().out
    memory.close()


def test_a_foreign_folder_does_not_stop_the_start(tmp_path: Path) -> None:
    MonitorMemory(tmp_path, 1).close()
    copy = tmp_path / FOLDER / "copy"
    copy.mkdir()
    (copy / "relay-0").write_bytes(b"x" * 20)
    MonitorMemory(tmp_path, 1).close()
    assert (copy / "relay-0").exists()
