import asyncio
import errno
import os
import socket
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from appliance.channel import channel
from appliance.channel.channel import AGAIN_SECONDS, Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Lifeline, Message, Ping, SocketKept
from appliance.relay.loop import READ, WRITE
from appliance.relay.transport.loop_channel import LoopLink

_BODY = msgspec.msgpack.Decoder(Lifeline)
TEMPORARY = [errno.ETOOMANYREFS, errno.ENOBUFS, errno.ENOMEM]


class Socket:
    def __init__(self) -> None:
        self.refusal = 0
        self.attempts = 0
        self.written = b""
        self.ended = False

    def setblocking(self, _flag: bool) -> None:
        """Act as a socket."""

    def fileno(self) -> int:
        return 99

    def send(self, data: bytes) -> int:
        self.attempts += 1
        if self.refusal:
            raise OSError(self.refusal, os.strerror(self.refusal))
        self.written += data
        return len(data)

    def sendmsg(self, parts: list[bytes], _descriptors: object, *_flags: object) -> int:
        return self.send(b"".join(parts))

    def shutdown(self, _how: int) -> None:
        self.ended = True

    def close(self) -> None:
        """Act as a socket."""

    def messages(self) -> list[Message]:
        found, position = list[Message](), 0
        while position < len(self.written):
            (length,) = struct.unpack_from(">I", self.written, position)
            position += 4 + length
            found.append(_BODY.decode(self.written[position - length : position]))
        return found


class Loop:
    def __init__(self) -> None:
        self.events = READ
        self.timers: list[tuple[float, Callable[..., None]]] = []

    def add_reader(self, _descriptor: int, _ready: Callable[[], None]) -> None:
        """Act as a loop."""

    remove_reader = watch = lambda *_given: None

    def add_writer(self, _descriptor: int, _ready: Callable[[], None]) -> None:
        self.events = READ | WRITE

    def remove_writer(self, _descriptor: int) -> None:
        self.events = READ

    def change(self, _descriptor: int, events: int) -> None:
        self.events = events

    def call_later(self, seconds: float, call: Callable[[], None]) -> SimpleNamespace:
        self.timers.append((seconds, call))
        return SimpleNamespace(cancel=lambda: None)

    after = call_later

    def run(self) -> None:
        timers, self.timers = self.timers, []
        for _seconds, call in timers:
            call()


@pytest.fixture
def sock(monkeypatch: pytest.MonkeyPatch) -> Socket:
    monkeypatch.setattr(
        channel, "os", SimpleNamespace(dup=lambda descriptor: descriptor, close=lambda _: None)
    )
    return Socket()


def attached(sock: Socket) -> tuple[Channel, Loop]:
    end, loop = Channel(cast(socket.socket, sock), Lifeline), Loop()
    end.attach(cast(asyncio.AbstractEventLoop, loop), lambda *_: None, lambda: None)
    return end, loop


@pytest.mark.parametrize("refusal", TEMPORARY)
def test_messages_that_the_kernel_refuses_for_a_while_are_sent_later_in_order(
    sock: Socket, refusal: int
) -> None:
    """A timer tries again: no event would, because the socket stays writable."""
    end, loop = attached(sock)
    sock.refusal = refusal
    sent = [SocketKept("first"), Ping(2), SocketKept("third"), Ping(4)]
    for message in sent:
        end.send(message, (7,) * message.descriptors)
    assert ([seconds for seconds, _ in loop.timers], loop.events) == ([AGAIN_SECONDS], READ)
    loop.run()
    assert len(loop.timers) == 1
    sock.refusal = 0
    loop.run()
    assert (sock.messages(), loop.timers, loop.events) == (sent, [], READ)


@pytest.mark.parametrize("refusal", TEMPORARY)
def test_a_relay_sends_later_what_the_kernel_refuses_for_a_while(sock: Socket, refusal: int) -> None:
    loop, ended = Loop(), list[str]()
    link = LoopLink(
        cast(Any, loop), Channel(cast(socket.socket, sock), Lifeline), lambda *_: None, ended.append
    )
    sock.refusal = refusal
    link.send(Ping(1))
    link.send(Ping(2))
    assert (len(loop.timers), loop.events, ended) == (1, READ, [])
    sock.refusal = 0
    loop.run()
    assert (sock.messages(), loop.timers, loop.events) == ([Ping(1), Ping(2)], [], READ)


def test_a_socket_that_is_full_is_written_when_it_is_writable(sock: Socket) -> None:
    end, loop = attached(sock)
    sock.refusal = errno.EAGAIN
    end.send(Ping(1))
    assert (loop.timers, loop.events) == ([], READ | WRITE)


@pytest.mark.parametrize("error", [errno.EPIPE, errno.EPERM])
def test_any_other_error_ends_the_stream_for_both_ends(sock: Socket, error: int) -> None:
    """Otherwise a message would be missing between others that arrive."""
    end, _loop = attached(sock)
    sock.refusal = error
    end.send(Ping(1))
    assert (sock.ended, end.pending) == (True, False)
    alone = Channel(cast(socket.socket, Socket()), Lifeline)
    vars(alone)["_socket"].refusal = error
    with pytest.raises(ChannelClosedError):
        alone.send(Ping(1))


def test_a_sender_sees_that_the_backlog_grows_before_it_is_full(sock: Socket) -> None:
    end = Channel(cast(socket.socket, sock), Lifeline, limit=1000)
    sock.refusal = errno.EAGAIN
    seen = []
    with pytest.raises(ChannelFullError):
        for number in range(1000):
            end.send(SocketKept(f"{number:040}"), (7,))
            seen.append(end.crowded)
    assert (seen[0], seen[-1]) == (False, True)
    assert 0.4 < seen.count(False) / len(seen) < 0.6
