"""A subscriber's connection: the publisher's header, then frames.

- No send blocks. Bytes that the socket does not accept wait in the subscriber's `SendQueue`.
- A subscriber that sends anything after its header is cut: a connection is for one topic.
"""

import errno
import os
import socket
from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice

from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.context import RelayContext
from appliance.relay.grant_table import PeerGrant
from appliance.relay.loop import READ, WRITE
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.frames import LARGE, Batch, own
from appliance.relay.transport.memory import HeldBytes, HostMemory, StallDetector
from appliance.relay.transport.pump import walk
from appliance.relay.transport.rate_limit import RateAllowance
from roswire.tcpros import encode_header

# The messages that wait for one slow subscriber: bounded, the oldest dropped first, never a torn frame.
#
# - Bytes leave in order; a frame whose first byte was sent is sent whole.
# - The rest of that frame counts as memory of the host.
# - A buffer is less than `LITTLE` times as large as what waits of it (`own`).
# - After `trim`, at most `queue_messages` frames and `queue_bytes` wait besides that frame. While more than `_BEHIND`
#   bytes wait, frames that came `_FRESH` before the newest are dropped: a camera over a slow link stays in the
#   present, as with a publisher's short queue in plain ROS. A burst that nothing follows is kept.

_VECTORS = 64
_BEHIND = 1 << 20
_FRESH = 1.0  # seconds
_NOTHING = memoryview(b"")


class SendQueue:
    """The frames that the socket of one subscriber has not accepted. Queues share the memory of batches."""

    def __init__(self, limits: RelayLimits, share: HostMemory, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._limit_messages = limits.queue_messages
        self._limit_size = limits.queue_bytes
        self._held = HeldBytes(share)
        self._started = _NOTHING
        # Frames, their number, and when they came.
        self._waiting: deque[tuple[memoryview, int, float]] = deque()
        self.messages = 0
        self.size = 0
        """The bytes of the messages, without a frame whose first byte was sent."""

    def __bool__(self) -> bool:
        return bool(self._started or self._waiting)

    @property
    def behind(self) -> bool:
        return self.size >= _BEHIND or self.full

    @property
    def begun(self) -> int:
        return len(self._started)

    @property
    def full(self) -> bool:
        return (
            self.messages >= self._limit_messages
            or self.size >= self._limit_size
            or (self.messages > 0 and self._held.share.exhausted)
        )

    def append(self, batch: Batch, sent: int = 0) -> None:
        """Queue a batch whose first `sent` bytes are already sent."""
        rest = batch.rest(sent)
        end, gone, _ = walk(batch.view, size=sent)
        if end > sent:
            self.begin(rest[: end - sent])
        if batch.messages > gone:
            self._waiting.append((own(rest[end - sent :]), batch.messages - gone, self._clock()))
            self._count(batch.messages - gone, len(batch.view) - end)

    def begin(self, rest: memoryview) -> None:
        self._started = own(rest)
        self._count(0, 0)

    def vectors(self) -> list[memoryview]:
        views = [view for view, _messages, _came in islice(self._waiting, _VECTORS)]
        return [self._started, *views] if self._started else views

    def advance(self, sent: int) -> None:
        if self._started:
            taken = min(sent, len(self._started))
            self.begin(self._started[taken:])
            sent -= taken
        while sent > 0:
            gone = self._remove(0, sent)
            if len(gone) > sent:
                self.begin(gone[sent:])
            sent -= len(gone)

    def trim(self) -> int:
        """Drop the oldest frames, or all if the host's memory is exhausted; return how many."""
        before = self.messages
        limit_messages, limit_size = self._limit_messages, self._limit_size
        if self._held.share.exhausted:
            limit_messages = limit_size = 0
        while self.messages > limit_messages or self.size > limit_size:
            self._remove(self.messages - limit_messages, self.size - limit_size)
        while self.size > _BEHIND and self._waiting[0][2] < self._waiting[-1][2] - _FRESH:
            self._remove(0, self.size - _BEHIND)
        return before - self.messages

    def clear(self) -> None:
        self._started = _NOTHING
        self._waiting.clear()
        self._count(-self.messages, -self.size)

    def _remove(self, messages: int, size: int) -> memoryview:
        """Remove the first frames until they are both numbers, or the first batch ends; return them."""
        view, number, came = self._waiting.popleft()
        end, gone, _ = max(walk(view, messages), walk(view, size=size))
        if gone < number:
            self._waiting.appendleft((own(view[end:]), number - gone, came))
        self._count(-gone, -end)
        return view[:end]

    def _count(self, messages: int, size: int) -> None:
        self.messages += messages
        self.size += size
        self._held.set(self.size + len(self._started))


_ANY = "*"


class Subscriber:
    """One subscriber of one relayed topic.

    Exactly one of two callbacks is called, once: `ended(self)` after the connection is closed, or, if the types
    differ, `refuse(self, sock, reason)`, which takes over the socket.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        topic: RelayedTopic,
        host: str,
        fields: Mapping[str, str],
        *,
        refuse: Callable[["Subscriber", socket.socket, str], None],
        ended: Callable[["Subscriber"], None],
    ) -> None:
        self.topic = topic
        self.host = host
        self.caller_id = fields["callerid"]
        self._flow: RateAllowance | None = None
        self.missed = False
        self.behind_since: float | None = None
        self._loop = context.loop
        self._socket = sock
        self._send = sock.send
        self.fields = fields
        self._reporter = context.reporter
        self._refuse = refuse
        self._ended = ended
        self._share = context.memory.queues.of(host)
        self._queue = SendQueue(context.limits, self._share, context.loop.clock)
        self._writing = False  # whether the loop waits for space in the socket's buffer
        self._stall = StallDetector(context.limits.stall_seconds)
        self._number = 0
        self._live = True
        self._loop.watch(sock.fileno(), READ, self._ready, context.payer(host))

    @property
    def grant(self) -> PeerGrant:
        return "topic", self.topic.key, self.topic.topic, self.host, self.caller_id

    def greet(self, header: Mapping[str, str]) -> bool:
        mismatch = describe_mismatch(self.fields, header)
        if mismatch:
            self._live = False
            self._loop.unwatch(self._socket.fileno())
            self.topic.leave(self)
            self._refuse(self, self._socket, mismatch)
            return False
        self._number = self._reporter.opened(
            self.topic.key, self.topic.topic, "topic", self.host, self.caller_id
        )
        self._queue.begin(memoryview(encode_header(header)))
        self._flush()
        if self._queue:
            self._write(True)
        return self._live

    def admits(self, batch: Batch) -> bool:
        if self.exhausted and (self._writing or len(batch.view) > LARGE):
            return False
        return self._flow is None or self._flow.room(batch, self._loop.clock()) == batch.messages

    def deliver(self, batch: Batch) -> int:
        """Send or queue the batch; drop a large one while the host has no memory: its rest could not be kept."""
        if self._flow is not None:
            batch = self._flow.cut(batch, self._loop.clock(), self._on_limit)
            self._flow.take(batch)
            if not batch.messages:
                return 0
        sent, view = 0, batch.view
        if not self._writing:
            if len(view) > LARGE and self.exhausted:
                self.missed = True
                return batch.messages
            try:
                sent = self._send(view)
            except BlockingIOError:
                pass
            except OSError as error:
                self._cut_by(error, "cannot be written to")
                return 0
            if sent == len(view):
                return 0
        self._queue_rest(batch, sent)
        return 0

    def accepted(self, batch: Batch, sent: int) -> None:
        if sent < 0 and -sent not in {errno.EAGAIN, errno.EWOULDBLOCK}:
            self._cut_by(OSError(-sent, os.strerror(-sent)), "cannot be written to")
        else:
            self._queue_rest(batch, max(sent, 0))

    @property
    def descriptor(self) -> int:
        return -1 if self._writing or self._flow is not None else self._socket.fileno()

    def limit(self, flow: RateAllowance | None) -> None:
        self._flow = flow
        self.topic.differs()

    def _queue_rest(self, batch: Batch, sent: int) -> None:
        self._queue.append(batch, sent)
        self._write(True)
        if self.behind_since is None and self._queue.behind:
            self.behind_since = self._loop.clock()

    def _on_limit(self, messages: int, size: int) -> None:
        topic = self.topic
        self._reporter.limited(
            (topic.key, topic.topic, "subscriber", self.host, self.caller_id), messages, size
        )
        self.missed = True

    @property
    def exhausted(self) -> bool:
        return self._share.exhausted

    def trim(self) -> int:
        dropped = self._queue.trim()
        self.missed |= dropped > 0 and not self._queue.messages
        return dropped

    def check_stall(self) -> None:
        """Cut a subscriber that stalls within a message while its host's memory is exhausted."""
        begun = self._queue.begun if self.exhausted else 0
        if self._stall.has_stalled(begun, self._loop.clock()):
            self.cut("its host has no memory left in the relay, and it does not accept the rest of a message")

    def cut(self, reason: str) -> None:
        if self._live:
            self._live = False
            self._loop.discard(self._socket)
            self._queue.clear()
            self.topic.leave(self)
            self._reporter.closed(self._number, reason)
            self._ended(self)

    def _cut_by(self, error: OSError, what: str) -> None:
        self.cut(
            "" if isinstance(error, BrokenPipeError | ConnectionResetError) else f"{what}: {error.strerror}"
        )

    def _ready(self, events: int) -> None:
        if events & WRITE:
            self._flush()
        if self._live and events & ~WRITE:
            self._listen()

    def _flush(self) -> None:
        queue = self._queue
        try:
            sent = self._socket.sendmsg(queue.vectors())
        except BlockingIOError:
            return
        except OSError as error:
            self._cut_by(error, "cannot be written to")
            return
        queue.advance(sent)
        if not queue:
            self.behind_since = None
            self._write(False)
            self.topic.relieve()

    def _write(self, on: bool) -> None:
        if on != self._writing:
            self._writing = on
            self.topic.differs()
            self._loop.change(self._socket.fileno(), READ | WRITE if on else READ)

    def _listen(self) -> None:
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError as error:
            self._cut_by(error, "broke")
            return
        if not data:
            self.cut("")
            return
        reason = "sent data after its header; a connection is for one topic; open another connection for another topic"
        asked = ("topic", self.topic.topic)
        self._reporter.refused(self.topic.key, asked, self.host, self.caller_id, reason)
        self.cut(reason)


def describe_mismatch(wanted: Mapping[str, str], offered: Mapping[str, str]) -> str:
    """Return why the headers do not fit. As in ROS, the md5sum decides."""
    md5sum, real_md5sum = wanted.get("md5sum", _ANY), offered.get("md5sum", _ANY)
    if _ANY in {md5sum, real_md5sum} or md5sum == real_md5sum:
        return ""
    name, real_name = wanted.get("type", _ANY), offered.get("type", _ANY)
    if _ANY not in {name, real_name} and name != real_name:
        return f"topic types do not match: [{name}] vs. [{real_name}]"
    return (
        f"Client [{wanted.get('callerid', '')}] wants topic [{wanted.get('topic', '')}] to have"
        f" datatype/md5sum [{name}/{md5sum}], but our version has [{real_name}/{real_md5sum}]."
        " Dropping connection."
    )
