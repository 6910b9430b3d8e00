"""Identify what a monitor acts on: a publication or service with a sender, and one of the sender's messages."""

import struct
from collections import OrderedDict
from collections.abc import Mapping
from typing import NamedTuple, Protocol
from weakref import WeakValueDictionary

from appliance.relay.transport.frames import Batch
from appliance.relay.transport.pump import walk
from rosmop.run.outcomes import SEQ, MessageSender

# The progress of one batch through the monitors.

_LENGTH = struct.Struct("<I")
_MAX_TURNS = 64


class BatchProgress:
    """The progress of a batch, received at `time` (nanoseconds).

    `pieces` is the output so far. Messages from position `run` on are not yet in it, so unchanged ones can stay in
    their buffer.
    """

    __slots__ = (
        "_batch", "_gone", "_turns", "end", "messages", "pieces", "position", "run", "time", "view",
    )  # fmt: skip

    def __init__(self, batch: Batch, time: int) -> None:
        self._batch = batch
        self._gone = 0
        self.view = batch.view
        self.end = len(batch.view)
        self.messages = batch.messages
        self.time = time
        self.position = 0
        self.run = 0
        self.pieces: list[memoryview | bytes | bytearray] = []
        self._turns = 1

    def number_at(self, position: int) -> int:
        return self._batch.first + walk(self.view, size=position)[1]

    def turns(self) -> int:
        """Return how many messages to take one by one; the number doubles until some can be taken together."""
        turns = self._turns
        self._turns = min(2 * turns, _MAX_TURNS)
        return turns

    def walked(self, position: int, run: int, gone: int) -> None:
        if position > self.position:
            self._turns = 1
        self.position, self.run = position, run
        self._gone += gone

    def cut(self, position: int, following: int) -> None:
        self._gone += 1
        if position > self.run:
            self.pieces.append(self.view[self.run : position])
        self.run = following

    def replace(self, position: int, following: int, buffer: bytes | bytearray | memoryview) -> None:
        if position > self.run:
            self.pieces.append(self.view[self.run : position])
        self.pieces += (_LENGTH.pack(len(buffer)), buffer)
        self.run = following

    def stop(self) -> None:
        batch, taken = self._batch, self.number_at(self.position) - self._batch.first
        batch.left = self.messages - taken
        self._batch, self.messages, self.end = batch.head(taken), taken, self.position

    def result(self) -> Batch | None:
        if not self.run:
            return self._batch
        left = self.messages - self._gone
        if not left:
            return None
        if self.end > self.run:
            self.pieces.append(self.view[self.run : self.end])
        return Batch(memoryview(b"".join(self.pieces)), left, None, owned=True)


HEAD = 12
"""The reported bytes of `std_msgs/Header`: seq and stamp."""

_HEADER = struct.Struct("<III")
_SENDERS = 4096


class ObservationPoint(NamedTuple):
    """A topic or service of an incarnation, and the sender of its messages: publisher, client or server."""

    key: str
    resource: str
    host: str = ""
    caller_id: str = ""


NOWHERE = ObservationPoint("", "")
"""The point of timed events, which concern no message."""


class PointHolder(Protocol):
    """An object that keeps its point's names known as long as it exists."""

    point: ObservationPoint


class Senders:
    """Numbers observation points, so that senders of earlier messages can be named; the last `_SENDERS` are known."""

    def __init__(self) -> None:
        self._points: OrderedDict[int, ObservationPoint] = OrderedDict()
        self._numbers: dict[ObservationPoint, int] = {}
        self._holders: WeakValueDictionary[int, PointHolder] = WeakValueDictionary()
        self._last = 0

    def number(self, point: ObservationPoint) -> int:
        found = self._numbers.get(point)
        if found is None:
            self._last = found = self._last + 1
            self._numbers[point] = found
            self._points[found] = point
            if len(self._points) > _SENDERS:
                del self._numbers[self._points.popitem(last=False)[1]]
        self._points.move_to_end(found)
        return found

    def hold(self, number: int, holder: PointHolder) -> None:
        self._holders[number] = holder

    def names(self, number: int) -> tuple[str, str]:
        point = self.point(number) or NOWHERE
        return point.host, point.caller_id

    def point(self, number: int) -> ObservationPoint | None:
        holder = self._holders.get(number)
        return self._points.get(number) if holder is None else holder.point

    def last(self, topic: str, node: str = "") -> ObservationPoint | None:
        """Return the last publisher of a topic, also after its end, or this node."""
        every = (self._points[number] for number in reversed(self._points))
        return next((one for one in every if one.resource == topic and node in ("", one.caller_id)), None)


class ObservedMessage:
    """A message of a publication: its position in the batch, and the first bytes of its header, if it has one.

    If `progress` is None, `position` is the message's number in its publication.
    """

    __slots__ = ("_head", "_position", "_progress")

    def __init__(self, progress: BatchProgress | None, position: int, head: bytes) -> None:
        self._progress = progress
        self._position = position
        self._head = head

    def at(self, number: int) -> "ObservedMessage":
        """Return a copy that is valid after the batch, with the message's number."""
        return ObservedMessage(None, number, self._head)

    def sender(self, source: int) -> MessageSender:
        if len(self._head) == HEAD:
            return MessageSender(source, _HEADER.unpack(self._head)[0], SEQ)
        return MessageSender(source)

    def detail(self) -> Mapping[str, object]:
        progress, position = self._progress, self._position
        detail: dict[str, object] = {
            "number": progress.number_at(position) if progress is not None else position
        }
        if len(self._head) == HEAD:
            detail["seq"], seconds, nanoseconds = _HEADER.unpack(self._head)
            detail["stamp"] = f"{seconds}.{nanoseconds:09}"
        return detail
