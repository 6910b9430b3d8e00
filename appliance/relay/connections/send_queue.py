"""The messages that wait for one slow subscriber: bounded, the oldest dropped first, never a torn frame.

- Bytes leave in order; a frame whose first byte was sent is sent whole.
- The rest of that frame counts as memory of the host; its buffer is less than `LITTLE` times as large.
- After `trim`, at most `queue_messages` frames and `queue_bytes` wait besides that frame.
"""

from collections import deque

from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.frames import LITTLE
from appliance.relay.transport.memory import HostMemory
from appliance.relay.transport.pump import walk

_VECTORS = 64
_BEHIND = 1 << 20


class SendQueue:
    """The frames that the socket of one subscriber has not accepted. Queues share the memory of batches."""

    def __init__(self, limits: RelayLimits, share: HostMemory) -> None:
        self._limit_messages = limits.queue_messages
        self._limit_size = limits.queue_bytes
        self._share = share
        self._started: memoryview | None = None
        self._waiting: deque[tuple[memoryview, int]] = deque()
        self._messages = 0
        self._size = 0

    def __bool__(self) -> bool:
        return self._started is not None or bool(self._waiting)

    @property
    def messages(self) -> int:
        return self._messages

    @property
    def size(self) -> int:
        return self._size

    @property
    def behind(self) -> bool:
        return self._size >= _BEHIND or self.full

    @property
    def begun(self) -> int:
        return 0 if self._started is None else len(self._started)

    @property
    def short(self) -> bool:
        return bool(self) and self._share.exhausted

    @property
    def full(self) -> bool:
        return (
            self._messages >= self._limit_messages
            or self._size >= self._limit_size
            or (self._messages > 0 and self._share.exhausted)
        )

    def append(self, view: memoryview, messages: int, sent: int = 0, rest: memoryview | None = None) -> None:
        """Queue a batch whose first `sent` bytes are already sent. The batch, or its `rest`, must not change."""
        if sent:
            rest = view[sent:] if rest is None else rest
            end, gone, _ = walk(view, size=sent)
            if end > sent:
                self.begin(rest[: end - sent])
            view, messages = rest[end - sent :], messages - gone
        if messages:
            self._waiting.append((view, messages))
            self._count(messages, len(view))

    def begin(self, rest: memoryview) -> None:
        self._started = _apart(rest)
        self._share.add(len(rest))

    def vectors(self) -> list[memoryview]:
        views = [] if self._started is None else [self._started]
        for index, (view, _messages) in enumerate(self._waiting):
            if index == _VECTORS:
                break
            views.append(view)
        return views

    def advance(self, sent: int) -> None:
        if self._started is not None:
            taken = min(sent, len(self._started))
            self._share.add(-taken)
            sent -= taken
            rest = self._started[taken:]
            self._started = _apart(rest) if len(rest) else None
        while sent:
            view, messages = self._waiting.popleft()
            self._count(-messages, -len(view))
            if sent >= len(view):
                sent -= len(view)
                continue
            end, gone, _ = walk(view, size=sent)
            if end > sent:
                self.begin(view[sent:end])
            if messages > gone:
                self._waiting.appendleft((view[end:], messages - gone))
                self._count(messages - gone, len(view) - end)
            sent = 0

    def trim(self) -> int:
        """Drop the oldest frames, or all if the host's memory is exhausted; return how many."""
        before = self._messages
        limit_messages, limit_size = self._limit_messages, self._limit_size
        if self._share.exhausted:
            limit_messages = limit_size = 0
        while self._messages > limit_messages or self._size > limit_size:
            view, messages = self._waiting.popleft()
            too_many, too_much = self._messages - limit_messages, self._size - limit_size
            self._count(-messages, -len(view))
            end, dropped, _ = max(walk(view, too_many), walk(view, size=too_much))
            if dropped < messages:
                self._waiting.appendleft((view[end:], messages - dropped))
                self._count(messages - dropped, len(view) - end)
        return before - self._messages

    def clear(self) -> None:
        self._share.add(-self._size - (0 if self._started is None else len(self._started)))
        self._started = None
        self._waiting.clear()
        self._messages = self._size = 0

    def _count(self, messages: int, size: int) -> None:
        self._messages += messages
        self._size += size
        self._share.add(size)


def _apart(rest: memoryview) -> memoryview:
    return memoryview(bytes(rest)) if LITTLE * len(rest) <= memoryview(rest.obj).nbytes else rest
