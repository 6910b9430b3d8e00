import fcntl
import os
import signal
from pathlib import Path

import pytest
from rosrv_fleet.workers import Workers

from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly


def _hold(file: Path) -> None:
    with file.open() as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        file.with_name(f"held by {os.getpid()}").touch()
        while True:
            signal.pause()


def test_a_stopped_collector_has_no_file_open(tmp_path: Path) -> None:
    workers, file = Workers(2), tmp_path / "segment"
    file.touch()
    for _one in range(2):
        workers.submit(_hold, file)
    eventually(lambda: len(list(tmp_path.glob("held by *"))) == 2, "both workers hold the file")
    workers.close()
    with file.open() as free:
        fcntl.flock(free, fcntl.LOCK_EX | fcntl.LOCK_NB)
