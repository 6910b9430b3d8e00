"""The files with the state of monitors: of this life, of the one before, and what an orderly end leaves."""

import os
from pathlib import Path

import pytest

from appliance.channel.messages import StateGiven
from appliance.supervisor.monitor_memory import FOLDER, SIZE, MonitorMemory

WRITTEN = b"rosrvMS1\x01"


def given(memory: MonitorMemory, index: int) -> list[tuple[StateGiven, bytes]]:
    """What a relay gets, and the first bytes of each."""
    found = memory.given_to("relay", index)
    return [(message, os.pread(descriptor, 16, 0)) for message, descriptor in found]


def write(memory: MonitorMemory, index: int, more: bytes = b"") -> None:
    """A relay writes its state."""
    [*_, (message, descriptor)] = memory.given_to("relay", index)
    assert message.own
    os.pwrite(descriptor, WRITTEN + more, 0)


def test_each_relay_has_a_file_of_its_own_and_no_other_process_any(tmp_path: Path) -> None:
    """It is there in full from the start, so that no write fails later; nobody but root reads the folder."""
    memory = MonitorMemory(tmp_path, 2)
    assert [*memory.given_to("control", 0)] == []
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


def test_every_relay_reads_what_all_wrote_in_the_life_before(tmp_path: Path) -> None:
    """Without an orderly end, too: only then nothing says that it outlived the machine."""
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
        os.pwrite(next(second.given_to("relay", 0))[1], b"x", 0)


def test_a_life_that_is_killed_while_it_starts_loses_nothing(tmp_path: Path) -> None:
    """What the life before left stays until each relay has written its own."""
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


def test_the_files_of_lives_that_never_came_far_are_bounded(tmp_path: Path) -> None:
    """However often the appliance is killed while it starts."""
    for _ in range(10):
        write(MonitorMemory(tmp_path, 2), 0)
    assert len([*(tmp_path / FOLDER).iterdir()]) <= 5


def test_fewer_relays_forget_what_was_of_the_others(tmp_path: Path) -> None:
    """Once all that are left have written: it is not revived in a later life."""
    first = MonitorMemory(tmp_path, 2)
    write(first, 0, b"a")
    write(first, 1, b"b")
    write(MonitorMemory(tmp_path, 1), 0, b"c")
    assert [data[9:10] for _, data in given(MonitorMemory(tmp_path, 1), 0)] == [b"c", b"\0"]


def test_an_orderly_end_is_said_once(tmp_path: Path) -> None:
    """With the start of the machine that it was in, and the time; a life that begins takes it away."""
    first = MonitorMemory(tmp_path, 1)
    write(first, 0)
    boot = given(first, 0)[0][0].boot
    first.close()
    second = MonitorMemory(tmp_path, 1)
    assert given(second, 0)[-1][0].ended_boot == boot
    assert given(second, 0)[-1][0].ended_at > 0
    write(second, 0)
    assert given(MonitorMemory(tmp_path, 1), 0)[-1][0].ended_boot == ""


def test_a_disk_without_room_keeps_the_state_over_relays_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The appliance starts, and says what that means."""

    def full(_descriptor: int, _offset: int, _size: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    memory = MonitorMemory(tmp_path, 2)
    write(memory, 1, b"a")
    assert given(memory, 1)[-1][1][9:10] == b"a"
    assert "do not keep their state when the appliance ends" in capsys.readouterr().out
    memory.close()
