"""A real process holds SQLite's locks, as a reader may."""

import fcntl
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from appliance.audit.log.log import AuditLog, holders
from appliance.audit.log.log_database import open_for_reading
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly

_HOLD = """\
import fcntl, os, struct, sys
descriptor = os.open(sys.argv[1], os.O_RDONLY)
fcntl.fcntl(descriptor, fcntl.F_SETLK, struct.pack("hhqqi", fcntl.F_RDLCK, 0, int(sys.argv[2]), 1, 0))
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def holding(file: Path, byte: int) -> Iterator[int]:
    command = [sys.executable, "-c", _HOLD, str(file), str(byte)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process.pid
        process.kill()


@pytest.fixture
def log(tmp_path: Path) -> Iterator[AuditLog]:
    log = AuditLog(tmp_path / "audit.db", drive=ByHand)
    log.record(decision(log, 1))
    assert settle(log) is None
    yield log
    log.close()


@pytest.mark.parametrize(("suffix", "byte"), [("-shm", 120), ("-shm", 121), ("-shm", 122), ("", 0x40000000)])
def test_the_holder_of_a_writers_lock_is_found(log: AuditLog, suffix: str, byte: int) -> None:
    file = log.path.with_name(log.path.name + suffix)
    with holding(file, byte) as pid:
        # The kernel gives its list in parts: a lock that ends elsewhere can hide another one for once.
        eventually(lambda: holders(log.path) == [pid], "the holder is found")
    eventually(lambda: holders(log.path) == [], "only the log's own thread holds a lock, and for a moment")


def test_a_lock_without_a_process_is_found(log: AuditLog) -> None:
    file = log.path.with_name(log.path.name + "-shm")
    with file.open("rb") as opened:
        fcntl.fcntl(opened, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", fcntl.F_RDLCK, 0, 120, 1, 0))
        eventually(lambda: holders(log.path) == [-1], "the lock is found")


def test_an_ordinary_reader_is_not_reported(log: AuditLog) -> None:
    with holding(log.path.with_name(log.path.name + "-shm"), 124), holding(Path(__file__), 120):
        connection = open_for_reading(log.path)
        connection.execute("BEGIN")
        connection.execute("SELECT * FROM record").fetchone()
        eventually(
            lambda: holders(log.path) == [], "only the log's own thread holds a lock, and for a moment"
        )
        connection.close()
    assert holders(log.path.with_name("nowhere.db")) == []
