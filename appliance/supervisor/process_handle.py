"""Run one process from its start to its death, with the supervisor's end of its lifeline.

The kernel reports a death on a pid descriptor, so a reused process id causes no confusion.
"""

import asyncio
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import msgspec
import structlog

import appliance
from appliance.base import clock
from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import LinkOpened, Message, Ping, Walled
from appliance.network.hang_detection import ProcessActivity
from appliance.supervisor.child_entry import LaunchPlan

_LONGEST_LINE = 2000  # bytes; the rest of a longer line is a line of its own
_log = structlog.get_logger()


class ProgramOutput:
    """The output of a program, read until the program and all its children have ended."""

    def __init__(self, role: str, output: IO[bytes], loop: asyncio.AbstractEventLoop) -> None:
        self._role = role
        self._output = output
        self._loop = loop
        self._rest = b""
        os.set_blocking(output.fileno(), False)
        loop.add_reader(output.fileno(), self.read)

    def read(self) -> None:
        """Log the lines that there are."""
        try:
            data = os.read(self._output.fileno(), 1 << 16)
        except BlockingIOError:
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._rest and (not data or len(self._rest) > _LONGEST_LINE):
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            for start in range(0, len(line), _LONGEST_LINE):
                text = line[start : start + _LONGEST_LINE].decode("utf-8", "replace")
                _log.info("".join(c if c.isprintable() else "?" for c in text), process=self._role)
        if not data:
            self._loop.remove_reader(self._output.fileno())
            self._output.close()


# A start is mostly loading, and a killed process would load everything again. So a process that progresses gets more
# time.
FIRST_ANSWER_SECONDS = 60.0
LONGEST_START_SECONDS = 1800.0
ANSWER_SECONDS = 5.0
_PROGRAM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass(frozen=True)
class ProcessCallbacks:
    """The functions to call for the events of a process."""

    received: Callable[["ProcessHandle", Message, tuple[int, ...]], None]
    violated: Callable[["ProcessHandle", str], None]
    died: Callable[["ProcessHandle", int], None]


def is_hanging(silent: float, *, starting: bool, still: float) -> bool:
    """Return whether a process that has been silent for some seconds is hanging.

    During a start, the silence counts from the beginning. A start may take a long time while it makes progress:
    `still` is the number of seconds without progress.
    """
    if starting:
        return silent > LONGEST_START_SECONDS or (silent > FIRST_ANSWER_SECONDS and still > ANSWER_SECONDS)
    return silent > ANSWER_SECONDS


class ChildProcess:
    """A process of the appliance, and its pid descriptor."""

    def __init__(self, role: str, plan: LaunchPlan) -> None:
        """Start the process. Raises `OSError`."""
        self._loop = asyncio.get_running_loop()
        self.is_program = bool(plan.argv)
        self._process = subprocess.Popen(
            # -s: load no code from the process's home, which is its part of the state directory
            [
                str(Path(sys.executable).parent.resolve() / Path(sys.executable).name),
                "-P",
                "-s",
                "-m",
                "appliance.supervisor.child_entry",
                role,
                msgspec.json.encode(plan).decode(),
            ],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE if self.is_program else None,
            bufsize=0,
            cwd="/",
            env=_environment(plan.home),
            pass_fds=(plan.lifeline, *([plan.lender] if plan.lender is not None else [])),
            start_new_session=True,
        )
        self.pid = self._process.pid
        if self._process.stderr is not None:
            ProgramOutput(role, self._process.stderr, self._loop)
        self._progress = ProcessActivity(self.pid)
        try:
            self._pidfd = os.pidfd_open(self.pid)
        except OSError:  # too many open files: without a pid descriptor, nothing would watch the process
            self._process.kill()
            self._process.wait()
            raise

    def watch(self, died: Callable[[], None]) -> None:
        """Let a function be called, once `wait` does not block."""
        self._loop.add_reader(self._pidfd, died)

    def wait(self) -> int:
        """Return the exit status, or the negative number of the signal."""
        self._loop.remove_reader(self._pidfd)
        code = self._process.wait()
        os.close(self._pidfd)
        self._pidfd = -1
        return code

    def send_signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, number)

    def stalled_seconds(self) -> float:
        return self._progress.stalled_seconds()


class ProcessHandle:
    """A running process."""

    def __init__(
        self, role: str, index: int, child: ChildProcess, lifeline: Channel, reports: ProcessCallbacks
    ) -> None:
        """`lifeline` is the supervisor's end."""
        self.role = role
        self.index = index
        self.ready = False
        self.is_program = child.is_program
        self.pid = child.pid
        self.alive = True
        self.since = clock.Began()
        self.started = clock.now()
        self.answered: float | None = None
        self.sandbox: Walled | None = None
        self.congestion = ""  # the congestion control of a relay's sockets
        self.reason = ""  # why the process cannot serve, as it reported
        self.output: tuple[str, ...] = ()  # the last output lines of its program
        self._asked = 0
        self._reports = reports
        self._child = child
        child.watch(self._dead)
        self._channel: Channel | None = lifeline
        lifeline.attach(
            asyncio.get_running_loop(),
            partial(reports.received, self),
            self._lifeline_closed,
            self._refused,
        )

    @property
    def sandbox_state(self) -> tuple[str, list[str]]:
        if self.sandbox is None:
            return "", []
        calls = {"listed": "listed calls", "usual": "usual calls"}.get(self.sandbox.calls)
        files = f"Landlock {self.sandbox.landlock}" if self.sandbox.landlock else None
        return ", ".join(filter(None, (calls, files))) or "none", [
            lack[:200] for lack in self.sandbox.lacks[:8]
        ]

    def send(self, message: Message, descriptors: tuple[int, ...] = ()) -> None:
        """Send a message. A dead process is ignored, because its death is reported separately."""
        if self._channel is None:
            return
        try:
            self._channel.send(message, descriptors)
        except ChannelClosedError:
            pass
        except ChannelFullError as error:
            self._reports.violated(self, f"does not read its liveness pipe: {error}")

    def ping(self) -> None:
        self._asked += 1
        self.send(Ping(self._asked))

    def note_answer(self) -> None:
        self.answered = clock.now()

    def discount_pause(self, seconds: float) -> None:
        """Accept a later answer, because the supervisor did not run (a suspended machine)."""
        self.started += seconds
        if self.answered is not None:
            self.answered += seconds

    @property
    def is_hanging(self) -> bool:
        now = clock.now()
        # A role of the appliance may answer once, and then take a long time to load policy and specifications.
        starting = self.answered is None or not (self.ready or self.is_program)
        since = self.started if self.answered is None or starting else self.answered
        return is_hanging(now - since, starting=starting, still=self.stalled_seconds)

    @property
    def stalled_seconds(self) -> float:
        return self._child.stalled_seconds()

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        if self.alive:
            self._child.send_signal(number)

    def _refused(self, reason: str) -> None:
        self._channel = None
        self._reports.violated(self, f"sent an invalid message: {reason}")

    def _lifeline_closed(self) -> None:
        # Either an external program now runs, or a death will be reported soon. A role of the appliance that only
        # closed its lifeline is killed, because it could not be stopped in order.
        self._channel = None
        if not self.is_program:
            self.kill()

    def _dead(self) -> None:
        if self._channel is not None:
            # The process's last message may be unread; it gives the reason of a failed start.
            channel, self._channel = self._channel, None
            try:
                messages = channel.receive()
            except (ChannelClosedError, ValueError):
                messages = []
            for message, descriptors in messages:
                self._reports.received(self, message, descriptors)
            channel.close()
        code = self._child.wait()
        self.alive = False
        self._reports.died(self, code)


def link_processes(handle: ProcessHandle, other: ProcessHandle) -> None:
    here, there = socket.socketpair()
    with here, there:
        handle.send(LinkOpened(role=other.role, index=other.index), (here.fileno(),))
        other.send(LinkOpened(role=handle.role, index=handle.index), (there.fileno(),))


def _environment(home: str) -> dict[str, str]:
    kept = {name: os.environ[name] for name in ("LANG", "LC_ALL", "TZ") if name in os.environ}
    return {
        **kept,
        "HOME": home,
        "TMPDIR": home,  # SQLite needs it, because no other folder is writable
        "PATH": _PROGRAM_PATH,
        "PYTHONPATH": str(Path(appliance.__file__).resolve().parent.parent),
        "PYDANTIC_DISABLE_PLUGINS": "__all__",  # pydantic would search all installed packages for plugins
    }


def program_environment(home: str, extra: dict[str, str]) -> dict[str, str]:
    """Return the environment of a program; only language and time zone are inherited."""
    environment = _environment(home)
    del environment["PYTHONPATH"], environment["PYDANTIC_DISABLE_PLUGINS"]
    return {**environment, **extra}
