"""The progress of one batch through the monitors."""

import struct

from appliance.relay.transport.frames import Batch
from appliance.relay.transport.pump import walk

_LENGTH = struct.Struct("<I")
_MOST_TURNS = 64


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
        self._turns = min(2 * turns, _MOST_TURNS)
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
