import logging
import os
import signal
import subprocess
import sys

import pytest

from appliance.network import hang_detection as patience
from appliance.network.hang_detection import ProcessActivity, communicate

pytestmark = pytest.mark.nightly

BUSY = """
import sys, time
while time.process_time() < 0.8:
    pass
sys.stdout.write(str(len(sys.stdin.read())))
"""


def program(text: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", text],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "STILL_SECONDS", 0.3)
    monkeypatch.setattr(patience, "_LOOK_SECONDS", 0.05)
    monkeypatch.setattr(patience, "_SAY_SECONDS", 0.1)


def test_a_busy_program_is_waited_for_with_a_report(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), program(BUSY) as busy:
        assert communicate(busy, "x" * 1_000_000, "a table of rules") == ("1000000", "")
    assert "a table of rules, which has run for" in caplog.text


def test_a_hanging_program_is_ended_with_a_report() -> None:
    with program("import signal; signal.pause()") as hanging:
        with pytest.raises(TimeoutError, match=r"nft made no progress for \d+ seconds: ended after"):
            communicate(hanging, "", "nft")
        assert hanging.returncode == -signal.SIGKILL


def test_an_endless_loop_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "LONGEST_SECONDS", 0.5)
    with program("while True: pass") as endless, pytest.raises(TimeoutError, match="nft did not end"):
        communicate(endless, "", "nft")


def test_a_stopped_or_ended_process_makes_no_progress() -> None:
    with program("import sys; sys.stdin.read()") as stopped:
        os.kill(stopped.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, stopped.pid, os.WSTOPPED | os.WNOWAIT)
        seen = ProcessActivity(stopped.pid)
        seen.stalled_seconds()
        first = seen.stalled_seconds()
        assert seen.stalled_seconds() > first
        stopped.kill()
        stopped.wait()
        assert seen.stalled_seconds() > first
