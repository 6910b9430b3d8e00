"""Run a forwarder of the audit log as a process: lifeline, link to control, and a thread that forwards.

The process can read the audit log and write only the stored position, and reaches only the receiver.
"""

import asyncio
import contextvars
import socket
import threading
from collections.abc import Callable
from typing import Protocol

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child

_REPORT_SECONDS = 1.0
_LAST_SECONDS = 2.5  # of the 3 s that the supervisor gives: a robot that is switched off reports this


class Forwarder(Protocol):
    """The work of a forwarding process; one thread calls `step` and `close`."""

    @property
    def progress(self) -> messages.ForwardingReported:
        """Return the progress so far; any thread reads it."""

    def step(self) -> float:
        """Forward a part; return the seconds to wait before the next call."""

    def close(self, *, stopped: bool = False) -> None:
        """Close the connection. `stopped`: the whole appliance is stopped by order."""


class ForwardingProcess:
    """Connects the lifeline, the reports to control and the forwarding thread."""

    def __init__(self, forwarder: Forwarder, lifeline_fd: int) -> None:
        lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._child = Child(
            lifeline,
            messages.ForwardingLink,
            said=lambda _message: None,
            linked=lambda: self._reports.anew(self._forwarder.progress),
        )
        self._reports = ProgressReports(self._child.tell)
        self._ending = threading.Event()
        self._forwarder = forwarder

    async def run(self) -> None:
        # A daemon thread: shutdown does not wait for a hanging receiver; its batch is sent again at the next start.
        said_with_logs = contextvars.copy_context()  # keeps the process name in the thread's log lines
        thread = threading.Thread(
            target=said_with_logs.run, args=(self._forward,), name="forward", daemon=True
        )
        thread.start()
        self._child.attach(messages.Ready())
        while not self._child.ended.is_set():
            self._reports.tell(self._forwarder.progress)
            try:
                async with asyncio.timeout(_REPORT_SECONDS):
                    await self._child.ended.wait()
            except TimeoutError:
                if not thread.is_alive():
                    break  # the exception is a logged defect; the supervisor restarts the process
        self._ending.set()
        await asyncio.to_thread(thread.join, _LAST_SECONDS)

    def _forward(self) -> None:
        while not self._ending.is_set():
            self._ending.wait(self._forwarder.step())
        self._forwarder.close(stopped=self._child.stopped)


class ProgressReports:
    """Reports the progress to control.

    A new control process first gets the last report again, and compares it with the records of its predecessor.
    """

    def __init__(self, send: Callable[[messages.ForwardingReported], bool]) -> None:
        self._send = send
        self._told = messages.ForwardingReported()

    def tell(self, progress: messages.ForwardingReported) -> None:
        if progress != self._told and self._send(progress):
            self._told = progress

    def anew(self, progress: messages.ForwardingReported) -> None:
        if self._send(self._told):
            self.tell(progress)
