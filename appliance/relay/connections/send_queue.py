"""The messages that wait for one slow subscriber: bounded, the oldest dropped first, never a torn frame.

- Bytes leave in order; a frame whose first byte was sent is sent whole.
- The rest of that frame counts as memory of the host; its buffer is less than `LITTLE` times as large.
- After `trim`, at most `queue_messages` frames and `queue_bytes` wait besides that frame.
"""

from collections import deque
from itertools import islice

from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.frames import LITTLE, Batch
from appliance.relay.transport.memory import HeldBytes, HostMemory
from appliance.relay.transport.pump import walk

_VECTORS = 64
_BEHIND = 1 << 20
_NOTHING = memoryview(b"")


class SendQueue:
    """The frames that the socket of one subscriber has not accepted. Queues share the memory of batches."""

    def __init__(self, limits: RelayLimits, share: HostMemory) -> None:
        self._limit_messages = limits.queue_messages
        self._limit_size = limits.queue_bytes
        self._held = HeldBytes(share)
        self._started = _NOTHING
        self._waiting: deque[tuple[memoryview, int]] = deque()
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
            self._waiting.append((rest[end - sent :], batch.messages - gone))
            self._count(batch.messages - gone, len(batch.view) - end)

    def begin(self, rest: memoryview) -> None:
        little = LITTLE * len(rest) <= memoryview(rest.obj).nbytes
        self._started = memoryview(bytes(rest)) if little else rest
        self._count(0, 0)

    def vectors(self) -> list[memoryview]:
        views = [view for view, _messages in islice(self._waiting, _VECTORS)]
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
        if not self.full:
            return 0
        before = self.messages
        limit_messages, limit_size = self._limit_messages, self._limit_size
        if self._held.share.exhausted:
            limit_messages = limit_size = 0
        while self.messages > limit_messages or self.size > limit_size:
            self._remove(self.messages - limit_messages, self.size - limit_size)
        return before - self.messages

    def clear(self) -> None:
        self._started = _NOTHING
        self._waiting.clear()
        self._count(-self.messages, -self.size)

    def _remove(self, messages: int, size: int) -> memoryview:
        """Remove the first frames until they are both numbers, or the first batch ends; return them."""
        view, number = self._waiting.popleft()
        end, gone, _ = max(walk(view, messages), walk(view, size=size))
        if gone < number:
            self._waiting.appendleft((view[end:], number - gone))
        self._count(-gone, -end)
        return view[:end]

    def _count(self, messages: int, size: int) -> None:
        self.messages += messages
        self.size += size
        self._held.set(self.size + len(self._started))
