import errno
import os
import signal
import socket
import subprocess

import pytest

from appliance.supervisor.child_entry import LaunchPlan
from appliance.supervisor.process_handle import (
    ANSWER_SECONDS,
    FIRST_ANSWER_SECONDS,
    LONGEST_START_SECONDS,
    ChildProcess,
    is_hanging,
)
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan
from appliance.supervisor.users import Account

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("silent", "starting", "still", "hanging"),
    [
        (ANSWER_SECONDS + 1, False, 0.0, True),
        (ANSWER_SECONDS - 1, False, 4.0, False),
        (ANSWER_SECONDS + 1, True, 0.0, False),
        (10 * FIRST_ANSWER_SECONDS, True, 1.0, False),
        (FIRST_ANSWER_SECONDS + 1, True, ANSWER_SECONDS + 1, True),
        (LONGEST_START_SECONDS + 1, True, 0.0, True),
    ],
)
def test_a_slow_start_is_waited_for_and_a_hang_is_not(
    silent: float, starting: bool, still: float, hanging: bool
) -> None:
    """A serving process must answer within seconds, but a starting one must only make progress."""
    assert is_hanging(silent, starting=starting, still=still) is hanging


@pytest.mark.nightly
async def test_a_process_that_cannot_be_watched_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def start(*_arguments: object, **_options: object) -> subprocess.Popen[bytes]:
        started.append(popen(["sleep", "60"]))
        return started[-1]

    def refuse(_pid: int) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(os, "pidfd_open", refuse)
    here, there = socket.socketpair()
    account = Account("rosrv", os.geteuid(), os.getegid())
    plan = LaunchPlan(os.getpid(), there.fileno(), account, "/", True, 64, SandboxPlan())
    with here, there, pytest.raises(OSError, match="Too many"):
        ChildProcess("relay", plan)
    assert [one.returncode for one in started] == [-signal.SIGKILL]
