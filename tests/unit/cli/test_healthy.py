"""Tests of the health check of a container."""

import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel.admin import AdminAnswer
from appliance.cli.healthy import unserved

SERVING: dict[str, Any] = {
    "probe": "passed",
    "audit": {"failed": None},
    "relay": "connected",
    "rosmaster": "reachable",
}


def check(state: Path) -> "subprocess.CompletedProcess[str]":
    """Run it as an engine does."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli.healthy"],
        env={"ROSRV_STATE": str(state)},
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_appliance_that_serves_is_healthy() -> None:
    """What status says of a running appliance is no reason, with and without a probe."""
    assert unserved(AdminAnswer(True, SERVING)) is None
    assert unserved(AdminAnswer(True, SERVING | {"probe": ""})) is None


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"probe": "ROSMaster can be reached"}, "not hidden: ROSMaster can be reached"),
        ({"audit": {"failed": "disk full"}}, "the audit log cannot be written: disk full"),
        ({"relay": "away"}, "no relay process"),
        ({"relay": "1 of 2 are away"}, "of the relay processes 1 of 2 are away"),
        ({"rosmaster": "away"}, "the ROS Master is being rebuilt"),
    ],
)
def test_what_keeps_nodes_from_being_served_is_named(wrong: dict[str, Any], reason: str) -> None:
    """Each reason why nodes are not served makes it unhealthy, in words."""
    assert reason in str(unserved(AdminAnswer(True, SERVING | wrong)))


def test_a_running_appliance_is_asked_over_its_socket(tmp_path: Path) -> None:
    """The program ends with 0 when the answer on the admin socket is good."""
    asked: list[bytes] = []

    def serve(listener: socket.socket) -> None:
        peer, _ = listener.accept()
        with peer:
            asked.append(peer.recv(1000))
            peer.sendall(msgspec.json.encode(AdminAnswer(True, SERVING)) + b"\n")

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "admin.sock"))
        listener.listen()
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        done = check(tmp_path)
        thread.join(30)
    assert (done.returncode, done.stderr, asked) == (0, "", [b'{"verb":"status"}\n'])


def test_an_appliance_that_does_not_run_is_unhealthy(tmp_path: Path) -> None:
    """Exit status 1 and the reason, no traceback."""
    done = check(tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("the appliance does not answer: ")
