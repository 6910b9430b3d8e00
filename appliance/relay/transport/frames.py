"""Find whole TCPROS frames in received bytes; every relayed message passes through this module.

A frame is a 4-byte little-endian length, followed by that many bytes. All whole frames of a read become one `Batch`,
without copying them.

- Small frames are received into a scratch area that all receivers share. If monitors run, it is in the memory of
  their WebAssembly module.
- The pump has the only loop over the lengths of frames (`walk`), which takes about 2 ns for a frame.
- A frame larger than `LARGE` gets its own area. An area of up to 8 MiB is reused for the next large frame, unless a
  queue has kept it or memory is short; it counts as a whole from its frame's first bytes on. A larger area is anonymous
  memory, so a declared length that is never sent costs only address space.
"""

import mmap
import struct
from collections.abc import Iterator
from math import ceil

from appliance.relay.transport.memory import HeldBytes, HostMemory
from appliance.relay.transport.pump import LARGE as _LARGE
from appliance.relay.transport.pump import SMALL as _SMALL
from appliance.relay.transport.pump import Pump, walk
from roswire.errors import LimitExceededError

SMALL = _SMALL
"""Unfinished data up to this size (bytes) on a connection is never refused."""

LARGE = _LARGE
SCRATCH = 512 << 10
_KEEP_AREA = 8 << 20  # a camera image fits; new memory for each image costs four times all other work

LITTLE = 8
"""Data is copied if its buffer is at least this many times larger, so that the buffer can be freed."""

_LENGTH = struct.Struct("<I")
_unpack_length = _LENGTH.unpack_from


def own(view: memoryview) -> memoryview:
    """Return the view, or a copy if it is little of its buffer."""
    little = LITTLE * len(view) <= memoryview(view.obj).nbytes
    return memoryview(bytearray(view)) if little else view


class Batch:
    """Consecutive whole frames in a buffer that is reused unless they are kept.

    `last` is the offset of the last frame (None: not known yet), and `first` the number of the first frame in its
    publication. `judged` is the time when monitors got the frames (0: never), and `answer` the result of their module
    if the pump has called it. `left` is the number of messages at the end that monitors had no time for.
    """

    __slots__ = ("_kept", "_owned", "answer", "first", "judged", "last", "left", "messages", "view")

    def __init__(self, view: memoryview, messages: int, last: int | None, *, owned: bool = False) -> None:
        self.view = view
        self.messages = messages
        self.last = last
        self.first = 1
        self.judged = 0
        self.answer: int | Exception | None = None
        self.left = 0
        self._owned = owned
        self._kept: memoryview | None = None

    @property
    def kept(self) -> bool:
        return self._kept is not None

    def keep(self) -> memoryview:
        """Return memory that will not be overwritten; copy the frames at most once."""
        if self._kept is None:
            self._kept = own(self.view) if self._owned else memoryview(bytes(self.view))
        return self._kept

    def rest(self, sent: int) -> memoryview:
        """Return the bytes after the first `sent`, in memory that will not be overwritten."""
        if self._kept is None and LITTLE * (len(self.view) - sent) <= len(self.view):
            return memoryview(bytes(self.view[sent:]))
        return self.keep()[sent:]

    def frames(self, after: int = 0) -> Iterator[memoryview]:
        start = walk(self.view, after)[0]
        while start < len(self.view):
            end = start + _LENGTH.size + _unpack_length(self.view, start)[0]
            yield self.view[start:end]
            start = end

    def within(self, size: float, most: int) -> int:
        if size <= 0:
            return 0
        if len(self.view) <= size or most == 1:
            return most
        return min(most, walk(self.view, size=ceil(size))[1])

    def head(self, count: int) -> "Batch":
        end, _, last = walk(self.view, count)
        head = Batch(self.view[:end], count, last, owned=self._owned)
        head.first = self.first
        return head

    def tail(self, count: int) -> "Batch":
        view = self.view[len(self.head(self.messages - count).view) :]
        tail = Batch(own(view) if self._owned else memoryview(bytearray(view)), count, None, owned=True)
        tail.first = self.first + self.messages - count
        return tail

    def find_last(self) -> int:
        if self.last is None:
            self.last = walk(self.view)[2]
        return self.last

    def keep_last(self) -> "Batch":
        if self._owned and self.messages == 1:
            last = self.keep()
        else:
            last = memoryview(bytearray(self.view[self.find_last() :]))
        return Batch(last, 1, 0, owned=True)


class Scratch:
    """The area into which small frames are received; it may be replaced between two reads.

    It begins at a page boundary, because the kernel copies aligned data faster.
    """

    __slots__ = ("_pump", "area")

    def __init__(self, pump: Pump | None = None) -> None:
        self._pump = pump
        self.move(None)

    def move(self, area: memoryview | None) -> None:
        self.area = memoryview(mmap.mmap(-1, SCRATCH)) if area is None else area
        if self._pump is not None:
            self._pump.receive_into(self.area)

    def hold(self, batch: Batch) -> Batch:
        """Copy the batch into the area if it fits, because monitors are faster there."""
        size = len(batch.view)
        if size > len(self.area):
            return batch
        self.area[:size] = batch.view
        held = Batch(self.area[:size], batch.messages, batch.last)
        held.first = batch.first
        return held


class FrameReceiver:
    """Receives frames. Repeat: call `buffer()`, receive into it, call `received(count)`, deliver the batch."""

    def __init__(self, scratch: Scratch, limit: int, share: HostMemory) -> None:
        self._scratch = scratch
        self._limit = limit
        self._held = HeldBytes(share)
        self._torn = b""
        self._area: memoryview | None = None
        self._filled = 0
        self._target = 0
        self._delivered: Batch | None = None
        self._idle = True

    def buffer(self) -> memoryview:
        if self._area is not None:
            if self._delivered is not None and self._delivered.kept:
                self._area = _new_area(self._target)
                self._held.set(0)  # the keeper of the batch counts it
            self._delivered = None
            return self._area[self._filled : self._target]
        torn, scratch = self._torn, self._scratch.area
        if torn:
            scratch[: len(torn)] = torn
            return scratch[len(torn) :]
        return scratch

    def received(self, count: int) -> Batch | None:
        """Return the frames that are now complete, until the next call of `buffer`.

        Raises `LimitExceededError` for a frame beyond the limit, and if the publisher's host has no memory left for an
        unfinished frame.
        """
        self._idle = False
        if self._area is not None:
            return self._received_in_area(self._area, count)
        return self._walk(self._scratch.area, len(self._torn) + count, owned=False)

    def hand_over(self) -> bytes:
        torn, self._torn = self._torn, b""
        self._held.set(0)
        return torn

    def resume(self, torn: bytes) -> None:
        self._torn = torn

    def found(self, size: int, end: int, messages: int) -> Batch:
        area = self._scratch.area
        self._idle, self._torn = False, bytes(area[size:end])
        self._held.set(len(self._torn))
        return Batch(area[:size], messages, None)

    @property
    def small(self) -> bool:
        return self._area is None and len(self._torn) <= SMALL

    @property
    def unfinished(self) -> int:
        return self._filled

    def trim_buffer(self) -> None:
        """Free the area if no data arrived since the last call."""
        if self._idle and not self._filled and self._area is not None:
            self.abandon()
        self._idle = True

    def abandon(self) -> None:
        self._held.set(0)
        self._area, self._delivered, self._filled, self._torn = None, None, 0, b""

    def _walk(self, buffer: memoryview, end: int, *, owned: bool) -> Batch | None:
        position, messages, last = walk(buffer[:end])
        need = 4 + _unpack_length(buffer, position)[0] if position + 4 <= end else 0
        self._torn = b""
        if need > LARGE:
            if need - 4 > self._limit:
                raise _too_long(need - 4, self._limit)
            self._begin_area(need, buffer[position:end])
        elif position < end or self._held.size:
            self._torn = bytes(buffer[position:end])
            self._held.set(len(self._torn))
            if len(self._torn) > SMALL and self._held.share.exhausted:
                raise _no_memory()
        return Batch(buffer[:position], messages, last, owned=owned) if messages else None

    def _begin_area(self, need: int, start: memoryview) -> None:
        if need <= _KEEP_AREA and self._held.share.refusal(need - self._held.size):
            raise _no_memory()
        area = _new_area(need)
        area[: len(start)] = start
        self._area, self._target, self._filled = area, need, len(start)
        self._held.set(_resident(area, len(start)))

    def _received_in_area(self, area: memoryview, count: int) -> Batch | None:
        """Receive one frame at a time: a read ends with the frame, or where a next frame of equal length would end."""
        self._filled += count
        if self._filled > self._held.size:  # memory that was once filled stays allocated with the area
            self._held.set(_resident(area, self._filled))
        if self._filled < 4:
            return None
        need = _unpack_length(area, 0)[0] + 4
        if self._filled < need:
            if need - 4 > self._limit:
                raise _too_long(need - 4, self._limit)
            if self._held.share.exhausted:
                raise _no_memory()
            if need > len(area):
                self._begin_area(need, area[: self._filled])
            else:
                self._target = need
            return None
        if self._filled > need or need <= LARGE or need > _KEEP_AREA or not self._held.share.plenty:
            end = self._filled
            self.abandon()
            return self._walk(area, end, owned=True)
        self._filled, self._target = 0, need
        self._delivered = Batch(area[:need], 1, 0, owned=True)
        return self._delivered


def _new_area(size: int) -> memoryview:
    try:
        return memoryview(bytearray(size) if size <= _KEEP_AREA else mmap.mmap(-1, size))
    except (OSError, MemoryError):
        raise _no_memory() from None


def _resident(area: memoryview, filled: int) -> int:
    return filled if len(area) > _KEEP_AREA else len(area)  # Python fills a `bytearray` with zeros


def _no_memory() -> LimitExceededError:
    return LimitExceededError("the relay has no memory left for unfinished messages of this host")


def _too_long(length: int, limit: int) -> LimitExceededError:
    return LimitExceededError(f"a message of {length} bytes is declared; the limit is {limit} bytes")
