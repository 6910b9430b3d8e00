"""Tests of the health check of a container."""

import socket
import subprocess
import sys
import threading
from pathlib import Path

import msgspec

from appliance.channel.admin import AdminAnswer
from appliance.channel.answers.status import Status
from tests.support.answers import example

SERVING = example(Status, probe="passed", relay="connected", rosmaster="reachable")


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


def test_a_refusal_is_unhealthy(tmp_path: Path) -> None:
    """An appliance that cannot say how it stands is unhealthy, with what it says."""

    def serve(listener: socket.socket) -> None:
        peer, _ = listener.accept()
        with peer:
            peer.recv(1000)
            peer.sendall(msgspec.json.encode(AdminAnswer(False, error="not now")) + b"\n")

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "admin.sock"))
        listener.listen()
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        done = check(tmp_path)
        thread.join(30)
    assert (done.returncode, done.stderr) == (1, "not now\n")
