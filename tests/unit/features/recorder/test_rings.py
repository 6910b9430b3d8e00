import mmap
import os

import pytest
from pydantic import ByteSize

from appliance.features.recorder.rings import RecorderRings
from appliance.features.recorder.settings import RecorderRules
from appliance.supervisor.errors import StartError

MIB = 1 << 20


def test_a_relay_writes_its_own_part_and_the_recorder_reads_all() -> None:
    rings = RecorderRings(RecorderRules(memory=ByteSize(32 * MIB), topics=["/a*"], before=7), 2)
    [(given, written)] = rings.messages_for("relay", 1)
    assert [given.terms[name] for name in ("index", "seconds", "topics")] == [1, 7, ["/a*"]]
    read = {one.terms["index"]: descriptor for one, descriptor in rings.messages_for("recorder", 0)}
    assert [os.fstat(descriptor).st_size for descriptor in read.values()] == [16 * MIB, 16 * MIB]
    mmap.mmap(written, 0)[:5] = b"hello"
    assert os.pread(read[1], 5, 0) == b"hello"
    assert os.pread(read[0], 5, 0) == bytes(5)
    assert not list(rings.messages_for("control", 0))
    rings.close()
    with pytest.raises(OSError):
        os.fstat(written)


def test_no_process_shrinks_it_and_the_recorder_cannot_write() -> None:
    rings = RecorderRings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, written)] = rings.messages_for("relay", 0)
    [(_given, read)] = rings.messages_for("recorder", 0)
    for size in (0, 32 * MIB):
        with pytest.raises(PermissionError):
            os.ftruncate(written, size)
    with pytest.raises(OSError):
        os.pwrite(read, b"x", 0)
    with pytest.raises(PermissionError):
        mmap.mmap(read, 0)
    rings.close()


def test_another_user_cannot_reopen_it_for_writing() -> None:
    rings = RecorderRings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, read)] = rings.messages_for("recorder", 0)
    assert os.fstat(read).st_mode & 0o777 == 0o600
    rings.close()


def test_the_memory_is_there_from_the_start() -> None:
    rings = RecorderRings(RecorderRules(memory=ByteSize(16 * MIB)), 1)
    [(_given, written)] = rings.messages_for("relay", 0)
    assert os.fstat(written).st_blocks * 512 == 16 * MIB
    rings.close()


def test_more_than_the_machines_memory_is_refused() -> None:
    with pytest.raises(StartError, match=r"recorder\.memory: 1\.0PiB is more than .* set a smaller value"):
        RecorderRings(RecorderRules(memory=ByteSize(1 << 50)), 1)
