"""Tests of waiting for a program as long as it gets on."""

import logging
import os
import signal
import subprocess
import sys

import pytest

from appliance.network import patience
from appliance.network.patience import Progress, communicate

BUSY = """
import sys, time
while time.process_time() < 0.8:
    pass
sys.stdout.write(str(len(sys.stdin.read())))
"""


def program(text: str) -> "subprocess.Popen[str]":
    """A Python program with pipes."""
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


def test_what_gets_on_is_waited_for_with_words(caplog: pytest.LogCaptureFixture) -> None:
    """A program that computes for longer than a hang may last is waited for; it gets its input, whatever its size."""
    with caplog.at_level(logging.WARNING), program(BUSY) as busy:
        assert communicate(busy, "x" * 1_000_000, "a table of rules") == ("1000000", "")
    assert "a table of rules has run for" in caplog.text


def test_what_hangs_is_ended_with_words() -> None:
    """A program that waits for what does not come uses no processor: it is ended, and the error says so."""
    with program("import signal; signal.pause()") as hanging:
        with pytest.raises(TimeoutError, match=r"nft got no further for \d+ seconds: ended after"):
            communicate(hanging, "", "nft")
        assert hanging.returncode == -signal.SIGKILL


def test_what_runs_in_a_circle_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """However busy a program is, there is an end to the patience with it."""
    monkeypatch.setattr(patience, "LONGEST_SECONDS", 0.5)
    with program("while True: pass") as endless, pytest.raises(TimeoutError, match="nft did not end"):
        communicate(endless, "", "nft")


def test_a_process_that_was_stopped_or_has_ended_is_still() -> None:
    """Stopped by a signal, or gone, it gets no further."""
    with program("import sys; sys.stdin.read()") as stopped:
        os.kill(stopped.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, stopped.pid, os.WSTOPPED | os.WNOWAIT)
        seen = Progress(stopped.pid)
        seen.still_seconds()
        first = seen.still_seconds()
        assert seen.still_seconds() > first
        stopped.kill()
        stopped.wait()
        assert seen.still_seconds() > first
