"""One life of one process: from its start to its death, with its end of the lifeline.

The supervisor is told what happens through callbacks; what to do about it (restart, stop) is not
decided here. A process is never waited for: the kernel reports its death on a pid descriptor, which no
reuse of the number can fool.
"""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

import appliance
from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Lifeline, LinkOpened, Message, Ping, Walled
from appliance.network.patience import Progress
from appliance.supervisor.child_entry import Plan

# Starting is mostly loading: killed too early on a slow machine, it would begin anew. So who gets on is waited for.
FIRST_ANSWER_SECONDS = 60.0
LONGEST_START_SECONDS = 1800.0
ANSWER_SECONDS = 5.0
_PROGRAM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass(frozen=True)
class Reports:
    """What the supervisor wants to hear of a life."""

    received: Callable[["Life", Any, tuple[int, ...]], None]
    violated: Callable[["Life", str], None]
    died: Callable[["Life", int], None]


def hangs(silent: float, *, starting: bool, still: float) -> bool:
    """Whether a process counts as hanging that did not answer for so many seconds, `still` of them without progress.

    While it starts, `silent` are the seconds since its start: it may take long as long as it gets on.
    """
    if starting:
        return silent > LONGEST_START_SECONDS or (silent > FIRST_ANSWER_SECONDS and still > ANSWER_SECONDS)
    return silent > ANSWER_SECONDS


class Life:
    """A running process."""

    def __init__(self, role: str, index: int, plan: Plan, lifeline: socket.socket, reports: Reports) -> None:
        """Start the process; `lifeline` is the supervisor's end, `plan.lifeline` the child's (both open)."""
        self.role = role
        self.index = index
        self.ready = False
        self.is_program = bool(plan.argv)
        self.since = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        self.started = time.monotonic()
        self.answered: float | None = None
        self.walls: Walled | None = None
        self.congestion = ""  # of a relay's sockets
        self.reason = ""  # why it cannot serve, in its own words
        self.output: tuple[str, ...] = ()  # the last lines of the program that it ran
        self._asked = 0
        self._reports = reports
        self._loop = asyncio.get_running_loop()
        self._process = subprocess.Popen(
            # -s: its home is a part of the state, no place to take code from
            [
                sys.executable,
                "-P",
                "-s",
                "-m",
                "appliance.supervisor.child_entry",
                role,
                msgspec.json.encode(plan).decode(),
            ],
            stdin=subprocess.DEVNULL,
            cwd="/",
            env=_environment(plan.home),
            pass_fds=(plan.lifeline,),
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._progress = Progress(self.pid)
        self._pidfd = os.pidfd_open(self.pid)
        self._loop.add_reader(self._pidfd, self._dead)
        self._channel: Channel | None = Channel(lifeline, Lifeline, longest=1 << 20)
        self._channel.attach(
            self._loop, partial(reports.received, self), self._lifeline_closed, self._refused
        )

    @property
    def alive(self) -> bool:
        """Whether its death has not been seen yet."""
        return self._pidfd >= 0

    @property
    def enclosed(self) -> tuple[str, list[str]]:
        """The walls it is in, in words, and what this kernel lacks of them."""
        if self.walls is None:
            return "", []
        calls = {"listed": "listed calls", "usual": "usual calls"}.get(self.walls.calls)
        files = f"Landlock {self.walls.landlock}" if self.walls.landlock else None
        return ", ".join(filter(None, (calls, files))) or "none", [
            lack[:200] for lack in self.walls.lacks[:8]
        ]

    def send(self, message: Message, descriptors: tuple[int, ...] = ()) -> None:
        """Tell the process something; nothing happens when it is gone (its death is reported by itself)."""
        if self._channel is None:
            return
        try:
            self._channel.send(message, descriptors)
        except ChannelClosedError:
            pass
        except ChannelFullError as error:
            self._reports.violated(self, f"does not read its lifeline: {error}")

    def ping(self) -> None:
        """Ask whether it is alive."""
        self._asked += 1
        self.send(Ping(self._asked))

    def heard(self) -> None:
        """Note that it is alive."""
        self.answered = time.monotonic()

    def forgive(self, seconds: float) -> None:
        """Do not count `seconds` in which the supervisor itself did not run (a suspended machine)."""
        self.started += seconds
        if self.answered is not None:
            self.answered += seconds

    @property
    def silent_too_long(self) -> bool:
        """Whether it has not answered for so long that it counts as hanging."""
        now = time.monotonic()
        # One of ours may answer once and then read policy and specifications, which takes as long as it takes.
        starting = self.answered is None or not (self.ready or self.is_program)
        since = self.started if self.answered is None or starting else self.answered
        return hangs(now - since, starting=starting, still=self.still_seconds)

    @property
    def still_seconds(self) -> float:
        """Seconds since it was last seen to get on with what it does, or to wait for a processor or a disk."""
        return self._progress.still_seconds()

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        """Send it a signal."""
        if not self.alive:
            return
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, number)

    def _refused(self, reason: str) -> None:
        self._channel = None
        self._reports.violated(self, f"sent what no process may send: {reason}")

    def _lifeline_closed(self) -> None:
        # A program that has taken over from the launcher, or a process that is about to be reported
        # dead. One of ours that merely closed its lifeline could never be stopped in order, and does
        # not answer: it is killed.
        self._channel = None
        if not self.is_program:
            self.kill()

    def _dead(self) -> None:
        self._loop.remove_reader(self._pidfd)
        if self._channel is not None:
            # Its last words (why it could not start) may still be unread.
            channel, self._channel = self._channel, None
            with suppress(ChannelClosedError, msgspec.DecodeError):
                for message, descriptors in channel.receive():
                    self._reports.received(self, message, descriptors)
            channel.close()
        code = self._process.wait()
        os.close(self._pidfd)
        self._pidfd = -1
        self._reports.died(self, code)


def link(one: Life, other: Life) -> None:
    """Give two processes the two ends of a fresh link."""
    here, there = socket.socketpair()
    with here, there:
        one.send(LinkOpened(role=other.role, index=other.index), (here.fileno(),))
        other.send(LinkOpened(role=one.role, index=one.index), (there.fileno(),))


def _environment(home: str) -> dict[str, str]:
    kept = {name: os.environ[name] for name in ("LANG", "LC_ALL", "TZ") if name in os.environ}
    return {
        **kept,
        "HOME": home,
        "TMPDIR": home,  # of SQLite: no other folder may be written
        "PATH": _PROGRAM_PATH,
        "PYTHONPATH": str(Path(appliance.__file__).parent.parent),
        "PYDANTIC_DISABLE_PLUGINS": "__all__",  # it looks for them in all that is installed
    }


def program_environment(home: str, extra: dict[str, str]) -> dict[str, str]:
    """The environment of a program that is not ours: nothing of the caller's but language and time zone."""
    environment = _environment(home)
    del environment["PYTHONPATH"], environment["PYDANTIC_DISABLE_PLUGINS"]
    return {**environment, **extra}
