"""Queue the frames that wait for one client: replies in order, and the newest messages of each topic.

A client that reads slowly loses the oldest messages of its topics, never a reply. Invariants:

1. At most `message_bytes` of messages wait. If more come, the topic with the most bytes loses its oldest message.
2. At most `reply_bytes` of replies wait. A client that requests more without reading gets `ViewerStalledError`.
3. Topics, and frames that wait, or are taken but not sent, are charged to the client's share of its door's memory. If
   it is full, the client's oldest messages are dropped, or the new one if that is not enough. A reply without room ends
   the connection.
4. Topics take turns, so that a large topic delays a small one by one message.
"""

from collections import OrderedDict, deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from appliance.features.doors.client_frames import ClientFrame, frame_size
from appliance.features.doors.door_memory import ClientMemory, DoorMemory, kept_bytes

_BURST = 1000
_BURST_BYTES = 256 << 10
"""The most bytes of a topic that may come at once, in one packet, before the first message is sent."""

_OVERHEAD = 300
"""The bytes that a waiting frame takes besides its own."""

_TOPIC_BYTES = 1000
"""The bytes that a topic takes besides its name and its messages."""

Key = TypeVar("Key", bound=Hashable)


class ViewerStalledError(Exception):
    """A client that makes requests and does not read the replies."""


@dataclass(slots=True)
class _Waiting:
    depth: int
    most_bytes: int
    interval: float
    items: deque[tuple[Any, int]] = field(default_factory=deque)
    bytes: int = 0
    next_time: float = 0.0
    queued: bool = False  # whether messages that come too early wait; otherwise they are dropped


class ViewerQueue(Generic[Key]):
    """The queue of one client; times are monotonic seconds."""

    def __init__(
        self,
        *,
        message_bytes: int = 16 << 20,
        reply_bytes: int = 16 << 20,
        memory: ClientMemory | None = None,
    ) -> None:
        self.dropped = 0
        self.memory = memory or DoorMemory().client()
        self._most_message_bytes = message_bytes
        self._most_reply_bytes = reply_bytes
        self._replies: deque[ClientFrame] = deque()
        self._reply_bytes = 0
        self._message_bytes = 0
        self._topics: dict[Key, _Waiting] = {}
        self._turns: OrderedDict[Key, _Waiting] = OrderedDict()  # topics with messages, the next one first

    def reply(self, frame: ClientFrame) -> None:
        if self.memory.closed:
            return
        size = frame_size(frame)
        if reason := self.memory.refusal(size + _OVERHEAD):
            raise ViewerStalledError(reason)
        self.memory.add(size + _OVERHEAD)
        self._reply_bytes += size
        if self._reply_bytes > self._most_reply_bytes and self._replies:
            raise ViewerStalledError(
                f"more than {self._most_reply_bytes} bytes of replies wait for this client"
            )
        self._replies.append(frame)

    def configure(self, key: Key, *, depth: int | None, interval: float) -> None:
        """Set the limits of a topic. With a depth, a message that comes too early waits; without one, it is dropped.

        Without a depth, only a few messages wait, and a large message only until the next one comes.
        """
        most, most_bytes = (_BURST, _BURST_BYTES) if depth is None else (depth, self._most_message_bytes)
        if key not in self._topics:
            self._topics[key] = _Waiting(most, most_bytes, interval)
            self.memory.keep(_TOPIC_BYTES + kept_bytes(key))
        topic = self._topics[key]
        topic.next_time += interval - topic.interval
        topic.depth, topic.most_bytes, topic.interval, topic.queued = (
            most,
            most_bytes,
            interval,
            depth is not None,
        )
        self._trim(topic)

    def remove(self, key: Key) -> None:
        topic = self._topics.pop(key, None)
        self._turns.pop(key, None)
        if topic is not None:
            self._message_bytes -= topic.bytes
            self.memory.add(-topic.bytes - _OVERHEAD * len(topic.items))
            self.memory.keep(-_TOPIC_BYTES - kept_bytes(key))

    def put(self, key: Key, item: object, size: int, now: float) -> None:
        topic = self._topics.get(key)
        if topic is None or self.memory.closed:
            return
        if topic.interval and not topic.queued:
            if now < topic.next_time:
                return
            topic.next_time = now + topic.interval
        while not self.memory.try_take(size + _OVERHEAD):
            if self.memory.refusal(size + _OVERHEAD - self._message_bytes):
                self.dropped += 1
                return
            self._drop_from_largest()
        if not topic.items:
            self._turns[key] = topic
        topic.items.append((item, size))
        topic.bytes += size
        self._message_bytes += size
        if len(topic.items) > topic.depth or topic.bytes > topic.most_bytes:
            self._trim(topic)
        while self._message_bytes > self._most_message_bytes:
            largest = max(self._turns.values(), key=lambda one: one.bytes)
            if len(largest.items) == 1 and largest is topic:
                break  # the newest message of the topic stays, whatever its size
            self._drop_from_largest()

    def take(self, now: float) -> "tuple[None, ClientFrame] | tuple[Key, Any] | None":
        """Return the next reply (with the key None) or message; None if nothing may be sent now."""
        if self._replies:
            frame = self._replies.popleft()
            size = frame_size(frame)
            self._reply_bytes -= size
            self.memory.send(size + _OVERHEAD)
            return None, frame
        for key, topic in self._turns.items():
            if not topic.queued or topic.next_time <= now:
                item, size = topic.items.popleft()
                topic.bytes -= size
                self._message_bytes -= size
                self.memory.send(size + _OVERHEAD)
                if topic.queued:
                    topic.next_time = now + topic.interval
                if topic.items:
                    self._turns.move_to_end(key)
                else:
                    del self._turns[key]
                return key, item
        return None

    def next_time(self) -> float | None:
        if self._replies:
            return 0.0
        if not self._turns:
            return None
        return min(topic.next_time if topic.queued else 0.0 for topic in self._turns.values())

    def _trim(self, topic: _Waiting) -> None:
        while len(topic.items) > topic.depth or (topic.bytes > topic.most_bytes and len(topic.items) > 1):
            self._drop(topic)

    def _drop_from_largest(self) -> None:
        key, topic = max(self._turns.items(), key=lambda one: one[1].bytes)
        self._drop(topic)
        if not topic.items:
            del self._turns[key]

    def _drop(self, topic: _Waiting) -> None:
        _item, size = topic.items.popleft()
        topic.bytes -= size
        self._message_bytes -= size
        self.memory.add(-size - _OVERHEAD)
        self.dropped += 1
