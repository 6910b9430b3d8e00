"""The relay as a process of the appliance: lifeline, link to control, and the loop that serves all.

The process ends when the supervisor says `Stop` or is gone (the lifeline ends). It outlives control: when the
link ends it goes on under the existing grants until the supervisor hands it a link to the next control.
"""

import contextlib
import logging
import resource
import socket
from dataclasses import replace
from typing import Any

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    Lifeline,
    LinkOpened,
    Ping,
    Pong,
    Ready,
    RelayLink,
    RingGiven,
    StateGiven,
    Stop,
)
from appliance.relay.bounds import Limits
from appliance.relay.connections.loop_channel import Link
from appliance.relay.connections.sockets import congestion_control
from appliance.relay.loop import Loop
from appliance.relay.monitors.keeper import Keeper
from appliance.relay.monitors.state_memory import mapped
from appliance.relay.recorder_ring import Recorded
from appliance.relay.relay import Engine

_DESCRIPTORS_BESIDE = 1024


def main(lifeline_fd: int, index: int, limits: Limits | None = None) -> None:
    """Run relay `index` until the supervisor ends it; `lifeline_fd` is this process's end of the lifeline."""
    RelayProcess(socket.socket(fileno=lifeline_fd), index, limits or Limits()).run()


class RelayProcess:
    """Binds an `Engine` to the lifeline and to whichever control is there."""

    def __init__(self, lifeline: socket.socket, index: int, limits: Limits) -> None:
        self._index = index
        self._descriptors = _raise_descriptor_limit(descriptors_for(limits.connections))
        self._limits = limits = fitted(limits, self._descriptors)
        self._loop = Loop()
        self._engine = Engine(self._loop, limits)
        self._lifeline = Link(self._loop, Channel(lifeline, Lifeline), self._obey, self._supervisor_gone)
        self._control: Link | None = None
        self._earlier: list[memoryview] = []

    def run(self) -> None:
        """Serve until told to stop."""
        detail = {
            "index": self._index,
            "congestion": congestion_control(),
            "connections": self._limits.connections,
            "descriptors": self._descriptors,
        }
        said = ", ".join(f"{name} {value}" for name, value in detail.items() if name != "index")
        logging.getLogger(__name__).info("relay %s serves: %s", self._index, said)
        self._lifeline.send(Ready(detail))
        self._loop.run()
        self._engine.close()
        if self._control is not None:
            self._control.close()
        self._lifeline.close()
        self._loop.close()

    def _obey(self, message: Any, descriptors: tuple[int, ...]) -> None:
        if isinstance(message, Ping):
            self._lifeline.send(Pong(message.number))
        elif isinstance(message, Stop):
            self._loop.stop()
        elif isinstance(message, LinkOpened) and message.role == "control":
            self._open_control(socket.socket(fileno=descriptors[0]))
        elif isinstance(message, RingGiven):
            self._engine.record(Recorded(message, descriptors[0], self._engine.middle.now))
        elif isinstance(message, StateGiven):
            self._keep_state(message, descriptors[0])
        else:
            raise TypeError(f"the supervisor sent a relay {type(message).__name__}")

    def _keep_state(self, given: StateGiven, descriptor: int) -> None:
        """Map a memory for the state of monitors; with its own, keep it there from now on."""
        memory = mapped(descriptor, writable=given.own)
        if given.own:
            self._engine.middle.remember(Keeper(given, memory, self._earlier))
            self._earlier = []
        else:
            self._earlier.append(memory)

    def _supervisor_gone(self, reason: str) -> None:
        logging.getLogger(__name__).error("relay %s ends: its supervisor is gone (%s)", self._index, reason)
        self._loop.stop()

    def _open_control(self, sock: socket.socket) -> None:
        if self._control is not None:
            self._control.close()
        self._control = Link(self._loop, Channel(sock, RelayLink), self._engine.take, self._control_gone)
        self._engine.attach(self._control)

    def _control_gone(self, reason: str) -> None:
        logging.getLogger(__name__).warning("relay %s: no control (%s); grants stay", self._index, reason)
        self._control = None
        self._engine.attach(None)


def descriptors_for(connections: int) -> int:
    """How many descriptors a relay needs: a client's connection may have one to its service or publisher."""
    return 2 * connections + _DESCRIPTORS_BESIDE


def fitted(limits: Limits, descriptors: int) -> Limits:
    """The limits, with no more connections than there are descriptors for: one too many is told so, and none hangs."""
    possible = max(1, (descriptors - _DESCRIPTORS_BESIDE) // 2)
    if possible >= limits.connections:
        return limits
    return replace(
        limits, connections=possible, connections_per_host=min(limits.connections_per_host, possible)
    )


def _raise_descriptor_limit(wanted: int) -> int:
    """Allow this process the descriptors its limits need, as far as the system lets it; how many it has."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        reachable = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (reachable, hard))
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return soft
