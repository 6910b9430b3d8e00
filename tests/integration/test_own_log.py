"""The log on standard error cannot be written, for every process, and later it can be."""

import contextlib
import fcntl
import io
import os
import subprocess
import threading
import xmlrpc.client
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.processes import ThisMachine
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

SETTINGS = """\
recorder: {enabled: true, memory: 16MiB, disk: 64MiB, triggers: []}
audit: {syslog: {to: "udp://127.0.0.1:9"}}
"""
CHANGED = OPEN_POLICY.replace("[Publishers]\n", "[Publishers]\n/cmd_vel = 127.0.0.1\n")


class Stderr(ThisMachine):
    """A machine whose programs have one standard error, which a test breaks and repairs."""

    path: ClassVar[str] = "/dev/null"

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.descriptor = os.open(self.path, os.O_WRONLY)

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        process = super().popen(args, **options | {"stderr": self.descriptor})
        os.close(self.descriptor)
        process.stderr = io.StringIO()
        return process

    @contextlib.contextmanager
    def broken(self) -> Iterator[None]:
        yield

    def said(self) -> str:
        """Return what was written after the repair, or nothing where it is never repaired."""
        return ""


class Full(Stderr):
    path = "/dev/full"


class ReaderGone(Stderr):
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        reader, self.descriptor = os.pipe()
        os.close(reader)


class ReaderStopped(Stderr):
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reader, self.descriptor = os.pipe()
        fcntl.fcntl(self.reader, fcntl.F_SETPIPE_SZ, 4096)
        os.write(self.descriptor, b"x" * 4096)
        self.text = b""

    @contextlib.contextmanager
    def broken(self) -> Iterator[None]:
        yield
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while part := os.read(self.reader, 4096):
            self.text += part

    def said(self) -> str:
        return self.text.decode()


class DiskFull(Stderr):
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "log"
        self.descriptor = os.open(self.file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    @contextlib.contextmanager
    def broken(self) -> Iterator[None]:
        with filled(self.folder):
            with contextlib.suppress(OSError), self.file.open("ab", buffering=0) as log:
                while True:  # the last block of the log has room
                    log.write(b"x\n")
            yield

    def said(self) -> str:
        return self.file.read_text()


KINDS = [DiskFull, Full, ReaderGone, ReaderStopped]


@contextlib.contextmanager
def started(kind: type[Stderr], settings: str = "") -> Iterator[tuple[Appliance, Stderr]]:
    """An appliance with its state on a small disk, which is also the disk of the log if it is on one."""
    appliance = Appliance(settings=settings, options=("--api", "127.0.0.1:0"))
    try:
        with small_disk(appliance.directory / "disk", "64m", "mode=755") as disk:
            appliance.state = disk / "state"
            appliance.host = machine = kind(disk)
            appliance.start()
            yield appliance, machine
            appliance.stop()
    finally:
        appliance.close()


def registered(appliance: Appliance, node: str) -> bool:
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        answer: Any = master.registerPublisher(node, "/chatter", "std_msgs/String", "http://127.0.0.1:9/")
    return bool(answer[0] == 1)


@pytest.mark.parametrize("kind", [pytest.param(DiskFull, marks=pytest.mark.real), *KINDS[1:]])
def test_a_full_disk_of_state_and_log_has_an_end(kind: type[Stderr]) -> None:
    """Requests are denied until there is space, and then allowed, without a restart; the gap is recorded."""
    with started(kind) as (appliance, machine):
        assert registered(appliance, "/before")
        with machine.broken(), filled(machine.folder) if kind is not DiskFull else contextlib.nullcontext():
            eventually(lambda: not registered(appliance, "/while"), "the log is not full")
        eventually(lambda: registered(appliance, "/after"), appliance.story)
        appliance.recorded("--event", "log failed")
        if kind in {DiskFull, ReaderStopped}:
            eventually(lambda: "the audit log is written again" in machine.said(), machine.said)
        killed = appliance.kill("relay")
        assert killed not in eventually(lambda: appliance.pids("relay"), appliance.story)
        assert registered(appliance, "/later")


@pytest.mark.parametrize("kind", KINDS)
def test_every_process_is_started_again(kind: type[Stderr]) -> None:
    with started(kind, SETTINGS) as (appliance, machine):
        roles = set(appliance.processes()) - {"supervisor"}
        assert {"control", "relay", "api", "signer", "rosmaster", "rosout", "recorder", "syslog"} <= roles
        breaks = contextlib.ExitStack()
        if kind is not DiskFull:  # a full state directory lets no process start
            breaks.enter_context(machine.broken())
        for role in sorted(roles):
            killed = appliance.pids(role)
            if not killed:  # started only when it is needed
                continue
            appliance.kill(role)
            eventually(lambda: set(appliance.pids(role)) - set(killed), f"{role} was not started again")  # noqa: B023  called before the next
            eventually(lambda: registered(appliance, f"/after_{role}"), appliance.story)  # noqa: B023  as above
        breaks.close()
        appliance.reload(CHANGED)
        appliance.recorded("--event", "policy loaded", count=2)
        if kind is ReaderStopped:
            eventually(lambda: "process ended" in machine.said() or None, machine.said)
