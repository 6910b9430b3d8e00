"""The log on standard error cannot be written, for every process, and later it can be."""

import contextlib
import fcntl
import io
import os
import subprocess
import sys
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.processes import ThisMachine
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

SETTINGS = """\
recorder: {enabled: true, memory: 16MiB, disk: 64MiB, triggers: []}
audit: {syslog: {to: "udp://127.0.0.1:9"}}
"""
Broken = Callable[[], AbstractContextManager[None]]
Said = Callable[[], str]
LogPlace = tuple[int, Broken, Said]
"""A descriptor for standard error; a block in which it cannot be written; and what was written."""
Kind = Callable[[Path], LogPlace]
CHANGED = OPEN_POLICY.replace("[Publishers]\n", "[Publishers]\n/cmd_vel = 127.0.0.1\n")


def of_a_full_disk(disk: Path) -> LogPlace:
    file = disk / "log"

    @contextlib.contextmanager
    def broken() -> Iterator[None]:
        with filled(disk):
            with contextlib.suppress(OSError), file.open("ab", buffering=0) as log:
                while True:  # the last block of the log has room
                    log.write(b"x\n")
            yield

    return os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND), broken, file.read_text


def full(_disk: Path) -> LogPlace:
    return os.open("/dev/full", os.O_WRONLY), contextlib.nullcontext, str


def without_a_reader(_disk: Path) -> LogPlace:
    reader, writer = os.pipe()
    os.close(reader)
    return writer, contextlib.nullcontext, str


def with_a_stopped_reader(_disk: Path) -> LogPlace:
    reader, writer = os.pipe()
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, b"x" * 4096)
    parts: list[bytes] = []

    def read() -> None:
        while part := os.read(reader, 4096):
            parts.append(part)

    @contextlib.contextmanager
    def broken() -> Iterator[None]:
        yield
        threading.Thread(target=read, daemon=True).start()

    return writer, broken, lambda: b"".join(parts).decode()


KINDS = [of_a_full_disk, full, without_a_reader, with_a_stopped_reader]
REPAIRED = {of_a_full_disk, with_a_stopped_reader}


@contextlib.contextmanager
def started(kind: Kind, settings: str = "") -> Iterator[tuple[Appliance, Path, Broken, Said]]:
    """An appliance with its state on a small disk, which is also the disk of the log if it is on one."""
    appliance = Appliance(settings=settings, options=("--api", "127.0.0.1:0"))

    def popen(_self: ThisMachine, args: Sequence[str], **options: Any) -> Any:
        process: Any = subprocess.Popen(list(args), **{**options, "stderr": descriptor})
        process.stderr = io.StringIO()
        return process

    try:
        with small_disk(appliance.directory / "disk", "64m", "mode=755") as disk:
            appliance.state = disk / "state"
            descriptor, broken, said = kind(disk)
            with mock.patch.object(ThisMachine, "popen", popen):
                appliance.start()
            os.close(descriptor)
            yield appliance, disk, broken, said
            appliance.stop()
    finally:
        appliance.close()


def registered(appliance: Appliance, node: str) -> bool:
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        answer: Any = master.registerPublisher(node, "/chatter", "std_msgs/String", "http://127.0.0.1:9/")
    return bool(answer[0] == 1)


@pytest.mark.parametrize("kind", [pytest.param(of_a_full_disk, marks=pytest.mark.real), *KINDS[1:]])
def test_a_full_disk_of_state_and_log_has_an_end(kind: Kind) -> None:
    """Requests are denied until there is space, and then allowed, without a restart; the gap is recorded."""
    with started(kind) as (appliance, disk, broken, said):
        assert registered(appliance, "/before")
        with broken(), contextlib.nullcontext() if kind is of_a_full_disk else filled(disk):
            eventually(lambda: not registered(appliance, "/while"), "the log is not full")
        eventually(lambda: registered(appliance, "/after"), appliance.story)
        appliance.recorded("--event", "log failed")
        if kind in REPAIRED:
            eventually(lambda: "the audit log is written again" in said(), said)
        killed = appliance.kill("relay")
        eventually(lambda: set(appliance.pids("relay")) - {killed}, appliance.story)
        assert registered(appliance, "/later")


@pytest.mark.parametrize("kind", KINDS)
def test_every_process_is_started_again(kind: Kind) -> None:
    with started(kind, SETTINGS) as (appliance, _disk, broken, said):
        roles = set(appliance.processes()) - {"supervisor"}
        assert {"control", "relay", "api", "signer", "rosmaster", "rosout", "recorder", "syslog"} <= roles
        breaks = contextlib.ExitStack()
        if kind is not of_a_full_disk:  # a full state directory lets no process start
            breaks.enter_context(broken())
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
        if kind is with_a_stopped_reader:
            eventually(lambda: "process died" in said() or None, said)


_LOGS = {
    "appliance": "from appliance.supervisor.logs import configure_logs; configure_logs('tester')",
    "collector": "from rosrv_fleet.output import configure_log; configure_log()",
    "witness": (
        "import time; from appliance.features.standby.witness.enforcement import BoundedLog, write_error;"
        " BoundedLog(write_error, time.monotonic).add('no firewall')"
    ),
}
_REPORTS = """
import logging, threading, warnings, structlog
structlog.get_logger().error("own")
logging.getLogger("library").error("foreign")
warnings.warn("odd")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
print("goes on")
"""


@pytest.mark.parametrize("program", _LOGS)
def test_nothing_that_reports_fails_without_room(program: str) -> None:
    reports = _REPORTS if program != "witness" else 'print("goes on")'
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-c", f"{_LOGS[program]}\n{reports}"],
            stdout=subprocess.PIPE, stderr=full, text=True, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "goes on\n")
