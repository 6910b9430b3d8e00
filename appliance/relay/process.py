"""The relay as a process of the appliance: lifeline, link to control, and the loop.

Without a link to control, it continues under the existing grants until it gets a link to the next control.
"""

import contextlib
import gc
import logging
import pkgutil
import resource
import socket
from dataclasses import replace

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.relay.connections.message_sink import OpenSink
from appliance.relay.data_plane import DataPlane
from appliance.relay.loop import EventLoop
from appliance.relay.monitors.state_keeper import StateKeeper
from appliance.relay.monitors.state_memory import map_memory
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.loop_channel import LoopLink
from appliance.relay.transport.sockets import congestion_control

_DESCRIPTORS_BESIDE = 1024

# Collections of the middle generation before a full one (default: 10). With 20,000 slices, a full collection stops all
# messages for 15 ms. Until then, unreachable cycles of at most 700,000 objects (about 100 MB) stay in memory.
_UNTIL_FULL_COLLECTION = 100


def main(lifeline_fd: int, index: int, limits: RelayLimits | None = None) -> None:
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _UNTIL_FULL_COLLECTION)
    RelayProcess(socket.socket(fileno=lifeline_fd), index, limits or RelayLimits()).run()


class RelayProcess:
    """The data plane, with its lifeline and the link to the current control."""

    def __init__(self, lifeline: socket.socket, index: int, limits: RelayLimits) -> None:
        self._index = index
        self._descriptors = _raise_descriptor_limit(descriptors_for(limits.connections))
        self._limits = limits = fit_limits(limits, self._descriptors)
        self._loop = EventLoop()
        self._engine = DataPlane(self._loop, limits)
        self._lifeline = LoopLink(
            self._loop, Channel(lifeline, messages.Lifeline), self._obey, self._supervisor_gone
        )
        self._engine.heartbeat.line_wanted = lambda: self._lifeline.send(messages.HeartbeatLineWanted())
        self._control: LoopLink | None = None
        self._earlier: list[memoryview] = []

    def run(self) -> None:
        detail = {
            "index": self._index,
            "congestion": congestion_control(),
            "connections": self._limits.connections,
            "descriptors": self._descriptors,
        }
        said = ", ".join(f"{name} {value}" for name, value in detail.items() if name != "index")
        logging.getLogger(__name__).info("relay %s serves: %s", self._index, said)
        self._lifeline.send(messages.Ready(detail))
        self._loop.run()
        self._engine.close()
        if self._control is not None:
            self._control.close()
        self._lifeline.close()
        self._loop.close()

    def _obey(self, message: object, descriptors: tuple[int, ...]) -> None:
        if isinstance(message, messages.Ping):
            self._lifeline.send(messages.Pong(message.number))
        elif isinstance(message, messages.Stop):
            self._loop.stop()
        elif isinstance(message, messages.LinkOpened) and message.role == "control":
            self._open_control(socket.socket(fileno=descriptors[0]))
        elif isinstance(message, messages.MemoryGiven):
            open_sink: OpenSink = pkgutil.resolve_name(message.used_by)
            self._engine.copy_to(open_sink(message.terms, descriptors[0], self._engine.interceptor.now))
        elif isinstance(message, messages.StateGiven):
            self._keep_state(message, descriptors[0])
        elif isinstance(message, messages.HeartbeatGiven) and message.line:
            self._engine.heartbeat.use_line(descriptors[0])
        elif isinstance(message, messages.HeartbeatGiven):
            self._engine.heartbeat.share(map_memory(descriptors[0], writable=True), self._index)
        else:
            raise TypeError(f"the supervisor sent a relay {type(message).__name__}")

    def _keep_state(self, given: messages.StateGiven, descriptor: int) -> None:
        memory = map_memory(descriptor, writable=given.own)
        if given.own:
            self._engine.interceptor.remember(StateKeeper(given, memory, self._earlier))
            self._earlier = []
        else:
            self._earlier.append(memory)

    def _supervisor_gone(self, reason: str) -> None:
        logging.getLogger(__name__).error("relay %s stops: its supervisor is gone (%s)", self._index, reason)
        self._loop.stop()

    def _open_control(self, sock: socket.socket) -> None:
        if self._control is not None:
            self._control.close()
        self._control = LoopLink(
            self._loop, Channel(sock, messages.RelayLink), self._engine.take, self._control_gone
        )
        self._engine.attach(self._control)

    def _control_gone(self, reason: str) -> None:
        logging.getLogger(__name__).warning("relay %s: no control (%s); grants stay", self._index, reason)
        self._control = None
        self._engine.attach(None)


def descriptors_for(connections: int) -> int:
    """Return the descriptors to reserve: each connection of a peer may need a second connection."""
    return 2 * connections + _DESCRIPTORS_BESIDE


def fit_limits(limits: RelayLimits, descriptors: int) -> RelayLimits:
    """Return limits with no more connections than descriptors permit, so that surplus peers are refused."""
    possible = max(1, (descriptors - _DESCRIPTORS_BESIDE) // 2)
    if possible >= limits.connections:
        return limits
    return replace(
        limits, connections=possible, connections_per_host=min(limits.connections_per_host, possible)
    )


def _raise_descriptor_limit(wanted: int) -> int:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        reachable = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (reachable, hard))
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return soft
