"""Bytes in, whole TCPROS frames out: the walk every relayed message goes through.

A frame is a 4-byte little-endian length and that many bytes. `FrameReceiver` hands out the buffer to receive
into and returns all frames that are whole after each read as one `Batch`, walked once and not copied:

- Small frames are received into a scratch area that all receivers of the process share; only the torn frame
  at the end of a read, if there is one, is set aside until the rest arrives.
- A frame beyond `LARGE` gets an area of its own that is filled in place. An area of up to 8 MiB is used again
  for the next large frame unless a queue has kept it; a larger one is anonymous memory, so that a length which
  is declared and never sent costs address space only.

Frames are passed on whole, so a publisher that dies in the middle of one tears nobody's stream: what its
subscribers have been sent always ends with a frame.
"""

import mmap
import struct
from typing import Protocol

from appliance.ros.errors import LimitExceededError

LARGE = 128 << 10
SCRATCH = 512 << 10
_KEEP_AREA = 8 << 20  # a frame of a camera: memory that is new for each one costs four times the rest

_MANY = 4  # frames

_LENGTH = struct.Struct("<I")
_unpack_length = _LENGTH.unpack_from


class Memory(Protocol):
    """Where waiting bytes are counted: of the whole process, or of one host."""

    used: int

    @property
    def exhausted(self) -> bool:
        """Whether nothing more should be kept."""


class MemoryBudget:
    """Counts the bytes that wait in the process: unfinished large frames and queues."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.used = 0

    @property
    def exhausted(self) -> bool:
        """Whether nothing more should be kept."""
        return self.used >= self.limit


class Batch:
    """Whole frames, one after the other, in a buffer that is used again unless they are kept.

    `last` is where the last of the `messages` frames begins, None if that has to be looked for; `stride` the bytes of
    each of the frames if they are known to be equally long, else 0.
    """

    __slots__ = ("_kept", "_owned", "last", "messages", "stride", "view")

    def __init__(
        self, view: memoryview, messages: int, last: int | None, *, owned: bool = False, stride: int = 0
    ) -> None:
        self.view = view
        self.messages = messages
        self.last = last
        self.stride = stride
        self._owned = owned
        self._kept: memoryview | None = None

    @property
    def kept(self) -> bool:
        """Whether somebody holds on to the frames."""
        return self._kept is not None

    def keep(self) -> memoryview:
        """The frames in memory that stays as it is; copied at most once however many ask."""
        if self._kept is None:
            self._kept = self.view if self._owned else memoryview(bytes(self.view))
        return self._kept

    def keep_last(self) -> "Batch":
        """The last frame as a batch of its own, in memory that stays as it is."""
        if self._owned and self.messages == 1:
            self.keep()
            return self
        if self.last is None:
            self.last = last_frame(self.view)
        last = memoryview(bytes(self.view[self.last :]))
        return Batch(last, 1, 0, owned=True)


class FrameReceiver:
    """Finds the frames of one connection: `buffer()`, receive into it, `received(count)`, deliver, again."""

    def __init__(self, scratch: memoryview, limit: int, budget: Memory) -> None:
        self._scratch = scratch
        self._limit = limit
        self._budget = budget
        self._torn = b""
        self._area: memoryview | None = None
        self._filled = 0
        self._target = 0
        self._delivered: Batch | None = None

    def buffer(self) -> memoryview:
        """Where the next bytes of the connection go."""
        if self._area is not None:
            if self._delivered is not None and self._delivered.kept:
                self._area = _new_area(self._target)
            self._delivered = None
            return self._area[self._filled : self._target]
        torn = self._torn
        if torn:
            self._scratch[: len(torn)] = torn
            return self._scratch[len(torn) :]
        return self._scratch

    def received(self, count: int) -> Batch | None:
        """The frames that are whole now that `count` more bytes are in the buffer.

        The batch is good until the next call of `buffer`. Raises `LimitExceededError` for a frame beyond the limit,
        and when the process has no memory left for an unfinished one.
        """
        if self._area is not None:
            return self._received_in_area(self._area, count)
        return self._walk(self._scratch, len(self._torn) + count, owned=False)

    def charge(self, budget: Memory) -> None:
        """Count there from now on."""
        budget.used += self._filled
        self._budget.used -= self._filled
        self._budget = budget

    @property
    def unfinished(self) -> int:
        """The bytes that have come of a large frame that is not whole."""
        return self._filled

    def abandon(self) -> None:
        """The connection is gone: nothing unfinished counts any more."""
        self._budget.used -= self._filled
        self._area, self._delivered, self._filled, self._torn = None, None, 0, b""

    def _walk(self, buffer: memoryview, end: int, *, owned: bool) -> Batch | None:
        """All whole frames in `buffer[:end]`; the torn one after them is set aside."""
        limit = self._limit
        need = 0
        stride, messages = equal_frames(buffer, end)
        position = stride * messages
        last = position - stride
        while position + 4 <= end:
            need = _unpack_length(buffer, position)[0] + 4
            if position + need > end:
                break
            last = position
            position += need
            messages += 1
            stride = 0
        self._torn = b""
        if position < end:
            if position + 4 <= end and need > LARGE:
                if need - 4 > limit:
                    raise _too_long(need - 4, limit)
                self._begin_area(need, buffer[position:end])
            else:
                self._torn = bytes(buffer[position:end])
        if not messages:
            return None
        return Batch(buffer[:position], messages, last, owned=owned, stride=stride)

    def _begin_area(self, need: int, start: memoryview) -> None:
        """Go on with a frame of `need` bytes, of which `start` has come, in an area of its own."""
        area = _new_area(need)
        area[: len(start)] = start
        self._budget.used += len(start) - self._filled
        self._area, self._target, self._filled = area, need, len(start)

    def _received_in_area(self, area: memoryview, count: int) -> Batch | None:
        """One frame at a time: reads end where the frame ends, or where one as long as the last would."""
        self._filled += count
        self._budget.used += count
        if self._filled < 4:
            return None
        need = _unpack_length(area, 0)[0] + 4
        if self._filled < need:
            if need - 4 > self._limit:
                raise _too_long(need - 4, self._limit)
            if self._budget.exhausted:
                raise LimitExceededError("the relay has no memory left for the rest of this message")
            if need > len(area):
                self._begin_area(need, area[: self._filled])
            else:
                self._target = need
            return None
        if self._filled > need or need <= LARGE or need > _KEEP_AREA:
            end = self._filled
            self.abandon()
            return self._walk(area, end, owned=True)
        self._budget.used -= need
        self._filled, self._target = 0, need
        self._delivered = Batch(area[:need], 1, 0, owned=True)
        return self._delivered


def equal_frames(buffer: memoryview, end: int) -> tuple[int, int]:
    """How long the frames at the start of `buffer[:end]` are, and how many, if they are many and all equally long.

    (0, 0) if not. To see it in one look at the lengths is cheaper than to walk from frame to frame.
    """
    if end < 4:
        return 0, 0
    stride = _unpack_length(buffer, 0)[0] + 4
    count = end // stride
    if count < _MANY or _unpack_length(buffer, stride)[0] + 4 != stride:
        return 0, 0
    whole = count * stride
    if end - whole >= 4 and _unpack_length(buffer, whole)[0] + 4 <= end - whole:
        return 0, 0  # a whole frame that is shorter follows
    for place in range(4):
        if buffer[place:whole:stride].tobytes() != buffer[place : place + 1].tobytes() * count:
            return 0, 0
    return stride, count


def last_frame(view: memoryview) -> int:
    """Where the last of the whole frames in `view` begins."""
    position = last = 0
    while position < len(view):
        last = position
        position += _unpack_length(view, position)[0] + 4
    return last


def boundary_at(view: memoryview, offset: int) -> tuple[int, int]:
    """The frame that byte `offset` of `view` is in: how many frames end at or before it, and where it ends.

    `view` begins with a frame. When `offset` is exactly between two frames, the end is `offset` itself.
    """
    position = frames = 0
    while position < offset:
        position += _unpack_length(view, position)[0] + 4
        if position <= offset:
            frames += 1
    return frames, position


def _new_area(size: int) -> memoryview:
    """Memory for one large frame: from the heap, which is warm, or, beyond `_KEEP_AREA`, not there until filled."""
    return memoryview(bytearray(size) if size <= _KEEP_AREA else mmap.mmap(-1, size))


def _too_long(length: int, limit: int) -> LimitExceededError:
    return LimitExceededError(f"a message of {length} bytes is declared; the limit is {limit} bytes")
