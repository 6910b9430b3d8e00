"""Fork nodes and tools of Debian's Python from a process with rospy loaded, which is the slow part of a start.

A fork has its own session and the host's network namespace. It differs from a new process only in that the modules
are already in memory. roslaunch starts its nodes itself.
"""

import atexit
import contextlib
import functools
import json
import os
import selectors
import shutil
import socket
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.landshark import lab
from tests.support.processes import Host, ThisMachine

PYTHON = "/usr/bin/python3"  # the interpreter rospy is installed for
_SERVER = Path(__file__).parent / "rospy_nodes" / "fork_server.py"
_OWN_NAMESPACE = Path("/proc/thread-self/ns/net")
_ONE_AT_A_TIME = threading.Lock()


class Forking:
    def __init__(self, host: Host) -> None:
        self.host = host

    @property
    def address(self) -> str:
        return self.host.address

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        arguments = _of_python([str(arg) for arg in args], options["env"]["PATH"])
        if arguments is None or not isinstance(self.host, ThisMachine | lab.Host):
            return self.host.popen(args, **options)
        inside = self.host.namespace.path if isinstance(self.host, lab.Host) else _OWN_NAMESPACE
        return Fork(arguments, inside, **options)


class Fork(subprocess.Popen[Any]):
    def __init__(
        self,
        arguments: list[str],
        namespace: Path,
        *,
        env: Mapping[str, str],
        cwd: str,
        text: bool = False,
        errors: str | None = None,
        start_new_session: bool = True,
        **standard: Any,
    ) -> None:
        assert start_new_session
        self.args, self.returncode = arguments, None
        self.stdin = self.stdout = self.stderr = None
        with contextlib.ExitStack() as given:
            descriptors = []
            for name in ("stdin", "stdout", "stderr"):
                if standard[name] != subprocess.PIPE:
                    descriptors.append(standard[name].fileno())
                    continue
                reading, writing = os.pipe()
                mine, other, mode = (writing, reading, "w") if name == "stdin" else (reading, writing, "r")
                given.callback(os.close, other)
                descriptors.append(other)
                setattr(self, name, os.fdopen(mine, mode if text else f"{mode}b", errors=errors))
            descriptors.append(inside := os.open(namespace, os.O_RDONLY))
            given.callback(os.close, inside)
            self._report, other_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            descriptors.append(given.enter_context(other_end).fileno())
            order = {"arguments": arguments, "environment": dict(env), "folder": cwd}
            with _ONE_AT_A_TIME:
                socket.send_fds(_server(), [json.dumps(order).encode()], descriptors)
        self.pid = int(self._report.recv(16))

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        with selectors.PollSelector() as selector:
            selector.register(self._report, selectors.EVENT_READ)
            if not selector.select(timeout):
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        self.returncode = int(self._report.recv(16, socket.MSG_PEEK))  # any thread may ask, and repeatedly
        return self.returncode

    def send_signal(self, sig: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # its server may have seen its end first
                os.kill(self.pid, sig)

    def __del__(self) -> None:
        self._report.close()


@functools.cache
def _server() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("ROS", "PYTHON"))}
    with theirs:
        command = [PYTHON, "-u", "-X", "faulthandler", str(_SERVER), str(theirs.fileno())]
        server = subprocess.Popen(
            command,
            env=environment,
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    atexit.register(server.wait)
    atexit.register(ours.close)
    return ours


@functools.cache
def _is_python(program: str) -> bool:
    with Path(program).open("rb") as file:
        return file.readline().strip() == f"#!{PYTHON}".encode()


def _of_python(args: list[str], path: str) -> list[str] | None:
    if args[0] == PYTHON:
        return args[1:] if args[1] == "-c" or not args[1].startswith("-") else None
    program = shutil.which(args[0], path=path)
    return [program, *args[1:]] if program is not None and _is_python(program) else None
