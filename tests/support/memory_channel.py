import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from appliance.channel.channel import Channel
from appliance.channel.messages import Message


class MemoryChannel(Channel):
    """A channel in memory. As over a socket, the `peer` gets each message in a later turn of the loop."""

    def __init__(self, union: Any) -> None:
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(union).decode
        self.arrived: deque[bytes] = deque()
        self._received: Callable[[Any, tuple[int, ...]], None] | None = None
        self._ended: Callable[[], None] = lambda: None
        self._refused: Callable[[str], None] = lambda _reason: None
        self._runs_in: asyncio.AbstractEventLoop | None = None
        self.peer = self
        self.closed = False
        self.messages: list[Any] = []

    def send(self, message: Message, descriptors: tuple[int, ...] = (), *, soon: bool = False) -> None:
        assert not descriptors, "a file descriptor needs a socket"
        self.send_raw(self._encode(message))

    def send_raw(self, body: bytes) -> None:
        if not self.peer.closed:
            self.peer.arrived.append(body)
            self.peer.schedule(self.peer.deliver)

    def attach(
        self,
        loop: asyncio.AbstractEventLoop,
        received: Callable[[Any, tuple[int, ...]], None],
        closed: Callable[[], None],
        refused: Callable[[str], None] | None = None,
    ) -> None:
        self._received, self._ended = received, closed
        self._refused = refused if refused is not None else lambda _reason: closed()
        self._runs_in = loop
        self.schedule(self.end if self.peer.closed else self.deliver)

    def schedule(self, act: Callable[[], None]) -> None:
        if self._runs_in is not None and not self._runs_in.is_closed():
            self._runs_in.call_soon(act)

    def receive(self) -> list[tuple[Message, tuple[int, ...]]]:
        bodies, self.arrived = self.arrived, deque()
        return [(self._decode(body), ()) for body in bodies]

    def deliver(self) -> None:
        while self.arrived and self._received is not None and not self.closed:
            try:
                message = self._decode(self.arrived.popleft())
            except ValueError as error:
                self.close()
                self._refused(str(error))
                return
            self.messages.append(message)
            self._received(message, ())

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            if not self.peer.closed:
                self.peer.schedule(self.peer.end)

    def end(self) -> None:
        self.deliver()
        if not self.closed:
            self.close()
            self._ended()


def memory_link(union: Any) -> tuple[MemoryChannel, MemoryChannel]:
    here, there = MemoryChannel(union), MemoryChannel(union)
    here.peer, there.peer = there, here
    return here, there


class HeldChannel(Channel):
    """Control's end of a link whose other end is the test.

    `sent` has the messages with their descriptors. The test speaks with `say`, and ends the link with `end`.
    """

    def __init__(
        self,
        note: Callable[[Message], None] = lambda _message: None,
        *,
        full: Callable[[], bool] = lambda: False,
    ) -> None:
        self.sent: list[tuple[Message, tuple[int, ...]]] = []
        self.say: Callable[[Message], None] = lambda _message: None
        self.end: Callable[[], None] = lambda: None
        self._note, self._full = note, full

    @property
    def crowded(self) -> bool:
        return self._full()

    def send(self, message: Message, descriptors: tuple[int, ...] = (), *, soon: bool = False) -> None:
        self.sent.append((message, descriptors))
        self._note(message)

    def attach(
        self,
        loop: asyncio.AbstractEventLoop,
        received: Callable[[Any, tuple[int, ...]], None],
        closed: Callable[[], None],
        refused: Callable[[str], None] | None = None,
    ) -> None:
        self.say, self.end = (lambda message: received(message, ())), closed

    def close(self) -> None: ...

    def heard(self) -> list[Message]:
        """Take what was sent since the last call."""
        sent, self.sent = [message for message, _descriptors in self.sent], []
        return sent
