"""The memory of the flight recorder: who gets which of it, and that nobody can spoil it for others."""

import mmap
import os

import pytest
from pydantic import ByteSize

from appliance.configuration.settings import RecorderRules
from appliance.supervisor.errors import StartError
from appliance.supervisor.rings import Rings

MIB = 1 << 20


def test_a_relay_writes_into_its_own_and_the_recorder_reads_all() -> None:
    """What one writes the other sees; together they have what is configured."""
    rings = Rings(RecorderRules(memory=ByteSize(32 * MIB), topics=["/a*"], before=7), 2)
    [(given, written)] = rings.given_to("relay", 1)
    assert (given.index, given.seconds, given.topics) == (1, 7, ["/a*"])
    read = {one.index: descriptor for one, descriptor in rings.given_to("recorder", 0)}
    assert [os.fstat(descriptor).st_size for descriptor in read.values()] == [16 * MIB, 16 * MIB]
    mmap.mmap(written, 0)[:5] = b"hello"
    assert os.pread(read[1], 5, 0) == b"hello"
    assert os.pread(read[0], 5, 0) == bytes(5)
    assert not list(rings.given_to("control", 0))
    rings.close()
    with pytest.raises(OSError):
        os.fstat(written)


def test_nobody_makes_it_smaller_and_the_recorder_changes_nothing() -> None:
    """Reading it never fails because of a relay, and what a relay wrote is the relay's."""
    rings = Rings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, written)] = rings.given_to("relay", 0)
    [(_given, read)] = rings.given_to("recorder", 0)
    for size in (0, 32 * MIB):
        with pytest.raises(PermissionError):
            os.ftruncate(written, size)
    with pytest.raises(OSError):
        os.pwrite(read, b"x", 0)
    with pytest.raises(PermissionError):
        mmap.mmap(read, 0)
    rings.close()


def test_another_user_does_not_open_it_anew_to_write() -> None:
    """Who has it to read finds it in /proc: there the mode of the file says who may write, and the recorder may not."""
    rings = Rings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, read)] = rings.given_to("recorder", 0)
    assert os.fstat(read).st_mode & 0o777 == 0o600
    rings.close()


def test_the_memory_is_there_from_the_start() -> None:
    """Nobody finds out amid an incident that the machine has not got it."""
    rings = Rings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, written)] = rings.given_to("relay", 0)
    assert os.fstat(written).st_blocks * 512 == 16 * MIB
    rings.close()


def test_more_than_the_machine_has_is_refused() -> None:
    """With what to do, before anything is started."""
    with pytest.raises(StartError, match=r"recorder\.memory: 1\.0PiB are more than .* give less"):
        Rings(RecorderRules(memory=ByteSize(1 << 50)), 1)
