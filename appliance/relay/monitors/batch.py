"""One batch on its way through the monitors: what was taken, and what goes on.

Messages that nobody dropped or replaced leave in the buffer they came in; `run` is where those begin that have not
been cut off yet, `pieces` what goes on before them.
"""

import struct

from appliance.relay.connections.frames import Batch

_LENGTH = struct.Struct("<I")
_MOST_TURNS = 64


class Passage:
    """A batch of a publication, received at `time` (nanoseconds)."""

    __slots__ = (
        "_batch", "_gone", "_turns", "end", "messages", "pieces", "position", "run", "stride", "time",
        "view",
    )  # fmt: skip

    def __init__(self, batch: Batch, time: int) -> None:
        self._batch = batch
        self._gone = 0
        self.view = batch.view
        self.end = len(batch.view)
        self.messages = batch.messages
        self.stride = batch.stride
        self.time = time
        self.position = 0
        self.run = 0
        self.pieces: list[memoryview | bytes | bytearray] = []
        self._turns = 1

    def number_at(self, position: int) -> int:
        """The number of the message at a position among those of its publication."""
        if self.stride:
            return self._batch.first + position // self.stride
        number, walked = self._batch.first, 0
        while walked < position:
            walked += 4 + _LENGTH.unpack_from(self.view, walked)[0]
            number += 1
        return number

    def turns(self) -> int:
        """How many messages to take one by one: the more, the longer none could be taken together."""
        turns = self._turns
        self._turns = min(2 * turns, _MOST_TURNS)
        return turns

    def walked(self, position: int, run: int, gone: int) -> None:
        """Messages up to `position` were taken together; `gone` of them were dropped, the last before `run`."""
        if position > self.position:
            self._turns = 1
        self.position, self.run = position, run
        self._gone += gone

    def cut(self, position: int, following: int) -> None:
        """The message between these is dropped."""
        self._gone += 1
        if position > self.run:
            self.pieces.append(self.view[self.run : position])
        self.run = following

    def replace(self, position: int, following: int, buffer: bytes | bytearray | memoryview) -> None:
        """The message between these has another size now."""
        if position > self.run:
            self.pieces.append(self.view[self.run : position])
        self.pieces += (_LENGTH.pack(len(buffer)), buffer)
        self.run = following

    def stop(self) -> None:
        """Leave the messages that were not taken for later."""
        batch, taken = self._batch, self.number_at(self.position) - self._batch.first
        batch.left = self.messages - taken
        self._batch, self.messages, self.end = batch.head(taken), taken, self.position

    def result(self) -> Batch | None:
        """What goes on; None when nothing does."""
        if not self.run:
            return self._batch
        left = self.messages - self._gone
        if not left:
            return None
        if self.end > self.run:
            self.pieces.append(self.view[self.run : self.end])
        return Batch(memoryview(b"".join(self.pieces)), left, None, owned=True)
