"""Read one publisher's frames into its topic, no faster than its subscribers and the other publishers permit.

    WATCHED --quantum used up, or frames undelivered--> LEFT --queued--> QUEUED --next turn--> WATCHED

In WATCHED, the pump passes simple frames on. In LEFT and QUEUED, nothing is read.
"""

import os
import socket
from collections.abc import Callable
from enum import Enum, auto

from appliance.channel.messages.relay_link import Violation
from appliance.relay.connections.headers import size_of
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.context import RelayContext
from appliance.relay.loop import READ, LoopTimer
from appliance.relay.transport.frames import Batch, FrameReceiver
from appliance.relay.transport.memory import HeldBytes, StallDetector
from appliance.relay.transport.pump import JUDGED, RECEIVED, UNARMED, Left
from roswire.errors import LimitExceededError, PeerError

Lost = Callable[[str, Violation], None]
"""Called with the reason why the connection to a publisher is lost, and the kind of violation."""


class _State(Enum):
    WATCHED = auto()
    LEFT = auto()
    QUEUED = auto()
    CLOSED = auto()


class UpstreamReader:
    """The open connection to a publisher. `lost` is called at most once."""

    def __init__(
        self,
        context: RelayContext,
        topic: RelayedTopic,
        sock: socket.socket,
        header: dict[str, str],
        lost: Lost,
    ) -> None:
        memory = context.memory.frames.of(topic.host)
        self.header = header
        self.since = context.loop.clock()
        self._context = context
        self._loop = context.loop
        self._topic = topic
        self._socket = sock
        self._payer = context.payer(topic.host)
        self._lost = lost
        self._receiver = FrameReceiver(context.scratch, context.limits.message_bytes, memory)
        self._buffer = self._receiver.buffer
        self._pumped = context.loop.pump.connection()
        self._stall = StallDetector(context.limits.stall_seconds)
        self._state = _State.WATCHED
        self._pause: LoopTimer | None = None
        self._received_at = 0.0  # of the data that is left
        self._rest: Batch | None = None
        self._held = HeldBytes(memory)
        self._held_header = HeldBytes(memory)
        self._held_header.set(size_of(header))
        self._watch()

    def start(self, early: bytes) -> None:
        """Take the data that came with the header, if any: they fit into an unused buffer."""
        if early and self._state is _State.WATCHED:
            self._buffer()[: len(early)] = early
            self._on_data(len(early))

    def pause(self, seconds: float) -> None:
        if self._pause is None:
            self._loop.unwatch(self._socket.fileno())
            self._pause = self._loop.after(seconds, self._topic.relieve)

    def resume(self) -> None:
        if self._pause is None:
            return
        self._pause.cancel()
        self._pause = None
        if self._state is _State.WATCHED:
            self._watch()
        else:
            self._queue()

    def check_stall(self) -> None:
        self._receiver.trim_buffer()
        is_read = self._pause is None and self._state is _State.WATCHED
        held = self._receiver.unfinished if is_read else 0
        if self._stall.has_stalled(held, self._loop.clock()):
            seconds = self._context.limits.stall_seconds
            reason = f"{held} bytes of a message arrived, then no data for {seconds:g} s"
            self._lost(reason, "limit exceeded")

    def disarm(self) -> None:
        torn = self._pumped.disarm()
        if torn:
            self._receiver.resume(torn)

    def close(self) -> None:
        self._state = _State.CLOSED
        if self._pause is not None:
            self._pause.cancel()
        self._loop.discard(self._socket)
        self._rest = None
        self._held.set(0)
        self._held_header.set(0)
        self._pumped.disarm()
        self._receiver.abandon()

    def _watch(self) -> None:
        self._loop.watch(self._socket.fileno(), READ, self._ready, self._payer, self._pumped)

    def _ready(self, _events: int) -> None:
        if self._loop.waited:
            self._topic.delays.waited(self._loop.waited)
        left = self._pumped.step()
        if left is None:
            return
        self.disarm()
        if left.kind == UNARMED:
            try:
                count = self._socket.recv_into(self._buffer())
            except BlockingIOError:
                return
            except OSError as error:
                count = -(error.errno or 0)
            except PeerError as error:  # no memory
                self._lost(str(error), violation_of(error))
                return
            self._on_data(count)
        elif left.kind == RECEIVED:
            self._on_data(left.end)
        else:
            self._go_on_behind(left)
        self._arm()

    def _on_data(self, count: int) -> None:
        if count <= 0:
            broke = f"the connection to the publisher broke: {os.strerror(-count)}"
            self._lost(broke if count else "the publisher closed the connection", "")
            return
        since = self._loop.clock()
        try:
            batch = self._receiver.received(count)
        except PeerError as error:
            self._lost(str(error), violation_of(error))
            return
        if batch is not None:
            self._continue(self._topic.received(batch, since), since)

    def _go_on_behind(self, left: Left) -> None:
        batch = self._receiver.found(left.size, left.end, left.messages)
        batch.judged, batch.answer = left.judged, left.answer
        rest = None
        if left.kind == JUDGED:
            rest = self._topic.received(batch, left.since)
        else:
            self._topic.sent(batch, left.since, left.number, left.sent)
        self._continue(rest, left.since)

    def _arm(self) -> None:
        if self._state is not _State.WATCHED or not self._receiver.small:
            return
        simple = self._topic.simple()
        if simple is not None:
            torn = self._receiver.hand_over()
            self._pumped.arm(self._socket.fileno(), self._topic, *simple, torn=torn)

    def _continue(self, rest: Batch | None, since: float) -> None:
        """Leave the frames that are left for the next turn, or read on."""
        if self._state is _State.CLOSED:
            return
        if rest is not None or self._topic.undelivered:
            self._rest, self._received_at = rest, since
            self._held.set(self._topic.undelivered + (0 if rest is None else len(rest.view)))
            if self._state is _State.WATCHED:
                self._loop.unwatch(self._socket.fileno())
            self._state = _State.LEFT
            self._queue()
        elif self._state is not _State.WATCHED:
            self._state, self._rest = _State.WATCHED, None
            self._held.set(0)
            if self._pause is None:
                self._watch()

    def _queue(self) -> None:
        if self._pause is None and self._state is _State.LEFT:
            self._state = _State.QUEUED
            self._loop.later(self._go_on, self._payer)

    def _go_on(self) -> None:
        if self._state is not _State.QUEUED:
            return
        self._state = _State.LEFT
        if self._pause is not None:
            return
        self._topic.hand_out()
        rest = self._rest
        if rest is not None and self._pause is None and not self._topic.undelivered:
            rest = self._topic.go_on(self._context.scratch.hold(rest), self._received_at)
        self._continue(rest, self._received_at)


def violation_of(error: PeerError) -> Violation:
    return "limit exceeded" if isinstance(error, LimitExceededError) else "malformed"
