"""Send and receive typed messages and file descriptors over a Unix stream socket, without blocking.

A frame is a 4-byte big-endian length, followed by a MessagePack document. Descriptors are sent with the first byte of
their frame. The kernel never merges two sends with descriptors, so they are assigned to frames in order.

The kernel may refuse a write though the socket is writable: too many descriptors are on their way, or it has no
memory. Then the channel is `delayed`: nothing is lost, and its owner calls `flush()` after `AGAIN_SECONDS`.
"""

import contextlib
import errno
import os
import socket
import struct
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from appliance.channel.messages import Message

if TYPE_CHECKING:
    import asyncio  # processes without asyncio (a launcher, the relay) do not load it

_LENGTH = struct.Struct(">I")
_RECEIVE_SIZE = 262_144
_MAX_DESCRIPTORS = 64
_TOGETHER = 65_536  # the bytes of frames that are joined for one write
_MAX_UNCLAIMED = 65_536
SOON_SECONDS = 0.005  # `soon` frames wait for this time to be joined, because each wakeup is expensive
AGAIN_SECONDS = 0.1
_TEMPORARY = frozenset({errno.EAGAIN, errno.ETOOMANYREFS, errno.ENOBUFS, errno.ENOMEM})
_MAX_READS = 64  # the most reads in one `receive()`, so that an endless writer does not block other work


class ChannelClosedError(Exception):
    """The other end is gone."""


class ChannelFullError(Exception):
    """The other end does not read; a defect, because both ends belong to the appliance."""


class Channel:
    """One end of a link; `union` is a union of `Message` structs."""

    def __init__(
        self, sock: socket.socket, union: object, *, limit: int = 64 << 20, longest: int = 64 << 20
    ) -> None:
        """`limit` bounds the unsent backlog, and `longest` each received message, in bytes."""
        sock.setblocking(False)
        self._socket = sock
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder = msgspec.msgpack.Decoder(union)
        self._limit = limit
        self._longest = longest
        self._incoming = bytearray()
        self._descriptors: deque[int] = deque()
        self._outgoing: deque[tuple[bytes, list[int]]] = deque()
        self._backlog = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._writing = False
        self._again: asyncio.TimerHandle | None = None
        self.delayed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def pending(self) -> bool:
        return bool(self._outgoing)

    @property
    def crowded(self) -> bool:
        """Whether a sender that can wait should wait, because half of the backlog is in use."""
        return self._backlog > self._limit // 2

    def send(self, message: Message, descriptors: tuple[int, ...] = (), *, soon: bool = False) -> None:
        """Queue a message. Raises `ChannelFullError`. Descriptors are duplicated.

        `soon`: an attached channel writes the message within `SOON_SECONDS`, together with other messages.
        """
        if len(descriptors) != message.descriptors:
            raise ValueError(f"{type(message).__name__} travels with {message.descriptors} descriptors")
        body = self._encoder.encode(message)
        if self._backlog + len(body) > self._limit:
            raise ChannelFullError(
                f"a process of the appliance does not read: {self._backlog} bytes wait for it"
            )
        self._outgoing.append(
            (_LENGTH.pack(len(body)) + body, [os.dup(descriptor) for descriptor in descriptors])
        )
        self._backlog += len(body) + _LENGTH.size
        if self._loop is None:
            self.flush()
        elif not soon:
            self._flush_attached()
        elif len(self._outgoing) == 1:  # otherwise a write is already scheduled
            self._loop.call_later(SOON_SECONDS, self._flush_attached)

    def flush(self) -> None:
        """Write as much as the kernel accepts now. Raises `ChannelClosedError`."""
        self.delayed = False
        while self._outgoing:
            data, descriptors = self._next()
            try:
                sent = (
                    socket.send_fds(self._socket, [data], descriptors)
                    if descriptors
                    else self._socket.send(data)
                )
            except OSError as error:
                if error.errno not in _TEMPORARY:
                    raise ChannelClosedError(str(error)) from error
                self.delayed = error.errno != errno.EAGAIN
                break
            for descriptor in descriptors:
                os.close(descriptor)
            self._backlog -= sent
            if sent < len(data):
                self._outgoing[0] = (data[sent:], [])
                break
            self._outgoing.popleft()
        self._watch_writable()

    def _next(self) -> tuple[bytes, list[int]]:
        frames, size = [], 0
        while self._outgoing and not self._outgoing[0][1] and size < _TOGETHER:
            frames.append(self._outgoing.popleft()[0])
            size += len(frames[-1])
        if frames:
            self._outgoing.appendleft((b"".join(frames), []))
        return self._outgoing[0]

    def receive(self) -> list[tuple[Message, tuple[int, ...]]]:
        """Return all complete messages. The caller owns their descriptors.

        Raises `ChannelClosedError`. Raises `ValueError`, and leaves the link unusable, if a message does not belong
        to this link, is too long, or lacks its descriptors.
        """
        closed = False
        for _turn in range(_MAX_READS):
            try:
                data, descriptors, flags, _address = socket.recv_fds(
                    self._socket, _RECEIVE_SIZE, _MAX_DESCRIPTORS
                )
            except BlockingIOError:
                break
            except OSError:
                data, descriptors, flags = b"", [], 0
            self._descriptors.extend(descriptors)
            self._incoming += data
            if flags & socket.MSG_CTRUNC:
                raise msgspec.DecodeError("descriptors were lost: this process has too many files open")
            if len(self._descriptors) > _MAX_UNCLAIMED:
                raise msgspec.DecodeError(f"more than {_MAX_UNCLAIMED} descriptors that no message claims")
            if not data:
                closed = True
                break
        messages = self._take_messages()
        if closed and not messages:
            raise ChannelClosedError("the other end closed the link")
        return messages

    def _take_messages(self) -> list[tuple[Message, tuple[int, ...]]]:
        messages: list[tuple[Message, tuple[int, ...]]] = []
        position, available = 0, len(self._incoming)
        while available - position >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._incoming, position)
            if length > self._longest:
                raise msgspec.DecodeError(f"a message of {length} bytes; {self._longest} are allowed")
            end = position + _LENGTH.size + length
            if end > available:
                break
            message = self._decoder.decode(bytes(self._incoming[position + _LENGTH.size : end]))
            if len(self._descriptors) < message.descriptors:
                raise msgspec.DecodeError(f"{type(message).__name__} came without its descriptors")
            messages.append((message, tuple(self._descriptors.popleft() for _ in range(message.descriptors))))
            position = end
        del self._incoming[:position]
        return messages

    def attach(
        self,
        loop: "asyncio.AbstractEventLoop",
        received: Callable[[Message, tuple[int, ...]], None],
        closed: Callable[[], None],
        refused: Callable[[str], None] | None = None,
    ) -> None:
        """Serve this end from an asyncio loop.

        When the other end is gone, `closed()` is called once, after the last message. `send` then raises no
        `ChannelClosedError`. An invalid message closes the channel: `refused(reason)` is called, or `closed()`.
        """
        self._loop = loop

        def readable() -> None:
            try:
                messages = self.receive()
            except ChannelClosedError:
                self.close()
                closed()
                return
            except ValueError as error:
                self.close()
                if refused is None:
                    closed()
                else:
                    refused(str(error))
                return
            for message, descriptors in messages:
                received(message, descriptors)

        loop.add_reader(self.fileno(), readable)
        self._watch_writable()

    def detach(self) -> None:
        """Stop serving; messages stay in the socket until the next `attach`."""
        if self._loop is not None:
            self._loop.remove_reader(self.fileno())
            self._loop.remove_writer(self.fileno())
            self._loop, self._writing = None, False

    def _watch_writable(self) -> None:
        if self._loop is None:
            return
        if self.delayed and self._again is None:
            self._again = self._loop.call_later(AGAIN_SECONDS, self._write_again)
        wanted = self.pending and not self.delayed
        if self._writing == wanted:
            return
        self._writing = wanted
        if wanted:
            self._loop.add_writer(self.fileno(), self._flush_attached)
        else:
            self._loop.remove_writer(self.fileno())

    def _write_again(self) -> None:
        self._again = None
        self._flush_attached()

    def _flush_attached(self) -> None:
        if not self._outgoing:  # written or closed in the meantime
            return
        try:
            self.flush()
        except ChannelClosedError:
            # The reader reports the end of the stream after it has received the rest of the data.
            self._discard_outgoing()
            if self._socket.fileno() >= 0:
                self._watch_writable()
                # End the stream even after an error that does not mean its end.
                with contextlib.suppress(OSError):
                    self._socket.shutdown(socket.SHUT_RDWR)

    def _discard_outgoing(self) -> None:
        for _data, descriptors in self._outgoing:
            for descriptor in descriptors:
                os.close(descriptor)
        self._outgoing.clear()
        self._backlog = 0

    def close(self) -> None:
        if self._socket.fileno() < 0:
            return
        if self._loop is not None:
            self._loop.remove_reader(self.fileno())
            self._loop.remove_writer(self.fileno())
        self._socket.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._discard_outgoing()
        self._descriptors.clear()
