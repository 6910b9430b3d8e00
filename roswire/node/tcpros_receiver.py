"""Receive the frames of one TCPROS connection: small ones in batches, each large one into its own buffer.

The kernel writes a large frame directly into its buffer, so the frame is never copied. Invariants:

1. A frame of more than `limit` bytes ends the connection as soon as its length is known.
2. A large frame is stored only if `memory` has room for all of it; otherwise its bytes are dropped. The memory is
   returned immediately before delivery, so that the receiver can take it.
3. A frame is delivered only while one is wanted. Until then, its bytes wait, and the connection is not read.
4. Other tasks have a turn after each large frame, and after `_TURN` small ones.
5. Each frame is delivered once. An error of the receiver ends the connection.
"""

import asyncio
from collections.abc import Callable
from typing import cast

from roswire.errors import LimitExceededError
from roswire.node.network import NodeMemory
from roswire.tcpros import Body

_SMALL_BYTES = 1 << 16
_TURN = 64  # small frames after which other tasks have a turn
_LENGTH_BYTES = 4


class TcprosReceiver(asyncio.BufferedProtocol):
    """The protocol of one connection. `skipped` is called for each dropped frame."""

    def __init__(self, memory: NodeMemory, skipped: Callable[[], None]) -> None:
        self._limit = 0
        self._memory = memory
        self._skipped = skipped
        self._transport: asyncio.Transport
        self._deliver: Callable[[Body], None] | None = None
        self._small = bytearray(_SMALL_BYTES)
        self._begun = 0  # bytes of `_small` that are not delivered
        self._large: bytearray | None = None
        self._missing = 0  # bytes of the large frame, even if it is dropped
        self._ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def next(self, limit: int) -> Body:
        """Return the next frame. Raise `LimitExceededError`, or `OSError` if the connection ends."""
        frame: asyncio.Future[Body] = asyncio.get_running_loop().create_future()

        def take(body: Body) -> None:
            self._deliver = None
            frame.set_result(body)

        self._begin(take, limit)
        await asyncio.wait((frame, self._ended), return_when=asyncio.FIRST_COMPLETED)
        return await (frame if frame.done() else self._end())

    async def deliver_to(self, deliver: Callable[[Body], None], limit: int) -> None:
        """Deliver frames until the connection ends, then raise as `next` does."""
        self._begin(deliver, limit)
        await self._end()

    async def _end(self) -> Body:
        await asyncio.shield(self._ended)
        raise ConnectionResetError("the peer ended the connection")

    def _begin(self, deliver: Callable[[Body], None], limit: int) -> None:
        self._deliver, self._limit = deliver, limit
        self._go_on()

    def write(self, data: bytes) -> None:
        self._transport.write(data)

    def close(self) -> None:
        self._deliver = None
        self._transport.close()

    # --- called by the event loop ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.pause_reading()

    def get_buffer(self, _sizehint: int) -> memoryview:
        if self._large is not None:
            return memoryview(self._large)[-self._missing :]
        return memoryview(self._small)[self._begun :]

    def buffer_updated(self, count: int) -> None:
        if self._large is not None:
            self._missing -= count
            if not self._missing:
                self._finish_large(self._large)
                self._pause()
        else:
            self._begun += count
            self._take_frames()

    def connection_lost(self, error: Exception | None) -> None:
        self._deliver = None
        if self._large is not None:
            self._memory.add(-len(self._large))
            self._large = None
        if not self._ended.done():
            if error is None:
                self._ended.set_result(None)
            else:
                self._ended.set_exception(error)
                self._ended.exception()  # a caller may wait for it, and need not

    # --- frames ---

    def _pause(self) -> None:
        self._transport.pause_reading()
        if self._deliver is not None:
            asyncio.get_running_loop().call_soon(self._go_on)

    def _go_on(self) -> None:
        if self._deliver is not None:
            self._transport.resume_reading()
            try:
                self._take_frames()
            except Exception as error:  # noqa: BLE001  as an event loop does with an error of `buffer_updated`
                self._fail(error)

    def _take_frames(self) -> None:
        position, end, left = 0, self._begun, _TURN
        while self._deliver is not None and left:
            if self._missing:  # of a frame that is dropped
                dropped = min(self._missing, end - position)
                self._missing -= dropped
                position += dropped
            body = position + _LENGTH_BYTES
            if body > end or self._missing:
                break
            size = int.from_bytes(self._small[position:body], "little")
            if size > self._limit:
                self._fail(LimitExceededError(f"frame of {size} bytes; at most {self._limit} are allowed"))
                return
            if body + size <= end:
                position = body + size
                left -= 1
                self._deliver(bytes(memoryview(self._small)[body:position]))
            elif size > _SMALL_BYTES - _LENGTH_BYTES:
                position = self._begin_large(size, body, end)
            else:
                break
        self._small[: end - position] = self._small[position:end]
        self._begun = end - position
        if self._deliver is None or not left:
            self._pause()

    def _begin_large(self, size: int, begin: int, end: int) -> int:
        if self._memory.refusal(size):
            self._skipped()
            self._missing = size
            return begin
        self._memory.add(size)
        self._large = bytearray(size)
        self._large[: end - begin] = memoryview(self._small)[begin:end]
        self._missing = size - (end - begin)
        return end

    def _finish_large(self, body: bytearray) -> None:
        self._large = None
        self._memory.add(-len(body))
        if self._deliver is not None:
            self._deliver(body)

    def _fail(self, error: Exception) -> None:
        self._deliver = None
        self._ended.set_exception(error)
        self._transport.close()
