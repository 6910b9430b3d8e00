"""The forwarder as a process of the appliance: lifeline, link to control, and a thread that forwards.

It runs as a user of its own in the group that may read the audit log, and can write nothing but its position. The
firewall lets this user reach the receiver and nobody else. It outlives control: what control has committed is there.
"""

import asyncio
import contextvars
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.config import Settings, Syslog, load_resolved
from appliance.forwarding.forwarder import Forwarder, Progress
from appliance.forwarding.receiver import DatagramReceiver, Receiver, StreamReceiver, tls_context
from appliance.forwarding.syslog import LONGEST_DATAGRAM, LONGEST_IN_STREAM, Formatter

_log = structlog.get_logger()
_REPORT_SECONDS = 1.0
_LAST_SECONDS = 1.0


def main(lifeline_fd: int, config: Path) -> None:
    """Forward the log until the supervisor ends it."""
    asyncio.run(_Process(load_resolved(config), lifeline_fd).run())


class _Process:
    """The parts of the process and the wires between them."""

    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        self._lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._control: Channel | None = None
        self._told: messages.ForwardingReported | None = None
        self._stopping = asyncio.Event()
        self._ending = threading.Event()
        self._forwarder = make_forwarder(settings, Path.cwd() / "position.json")

    async def run(self) -> None:
        """Forward from start to end."""
        self._lifeline.attach(asyncio.get_running_loop(), self._received, self._stopping.set)
        # A daemon: when a receiver hangs, the end does not wait for it; its batch is sent again at the next start.
        said_with_logs = contextvars.copy_context()  # which process this is
        thread = threading.Thread(
            target=said_with_logs.run, args=(self._forward,), name="forward", daemon=True
        )
        thread.start()
        self._say(messages.Ready())
        while not self._stopping.is_set():
            self._report()
            try:
                await asyncio.wait_for(self._stopping.wait(), _REPORT_SECONDS)
            except TimeoutError:
                if not thread.is_alive():
                    break  # a defect, which it has said: the supervisor starts a fresh life
        self._ending.set()
        await asyncio.to_thread(thread.join, _LAST_SECONDS)

    def _forward(self) -> None:
        while not self._ending.is_set():
            self._ending.wait(self._forwarder.step())
        self._forwarder.close()

    def _report(self) -> None:
        message = report_of(self._forwarder.progress)
        if self._control is None or message == self._told:
            return
        try:
            self._control.send(message)
            self._told = message
        except (ChannelClosedError, ChannelFullError):
            self._control = None

    def _say(self, message: messages.Message) -> None:
        try:
            self._lifeline.send(message)
        except ChannelClosedError:
            self._stopping.set()

    def _received(self, message: Any, descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.Ping(number):
                self._say(messages.Pong(number))
            case messages.Stop():
                self._stopping.set()
            case messages.LinkOpened(role) if role == "control":
                self._link(Channel(socket.socket(fileno=descriptors[0]), messages.ForwardingLink))
            case _:
                for descriptor in descriptors:
                    os.close(descriptor)
                _log.error(
                    "the supervisor said what is not for the forwarder", message=type(message).__name__
                )

    def _link(self, channel: Channel) -> None:
        if self._control is not None:
            self._control.close()
        self._control, self._told = channel, None

        def lost(_reason: str = "") -> None:
            if self._control is channel:
                self._control = None

        channel.attach(asyncio.get_running_loop(), lambda _message, _descriptors: None, lost, lost)
        self._report()


def make_forwarder(settings: Settings, kept: Path) -> Forwarder:
    """What forwards as `settings` say; they must have a receiver."""
    wanted = settings.audit.syslog
    longest = LONGEST_DATAGRAM if wanted.destination[0] == "udp" else LONGEST_IN_STREAM
    return Forwarder(
        settings.state / "control" / "audit.db",
        kept,
        receiver_of(wanted),
        Formatter(facility=wanted.facility, longest=longest, host_name=wanted.host_name),
        chosen=wanted.send,
    )


def receiver_of(wanted: Syslog) -> Receiver:
    """The receiver that the configuration names."""
    protocol, host, port = wanted.destination
    if protocol == "udp":
        return DatagramReceiver(host, port)
    context: Callable[[], Any] | None = None
    if protocol == "tls":
        # Made anew for each connection: files that were replaced count from the next one on.
        def context() -> Any:
            return tls_context(wanted.ca, wanted.certificate, wanted.key)

    return StreamReceiver(host, port, context, wanted.name)


def report_of(progress: Progress) -> messages.ForwardingReported:
    """What control is told."""
    return messages.ForwardingReported(**msgspec.structs.asdict(progress))
