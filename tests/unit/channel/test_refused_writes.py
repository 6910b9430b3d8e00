import asyncio
import errno
import os
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.channel import AGAIN_SECONDS, Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Lifeline, Message, Ping, SocketKept
from appliance.relay.transport.loop_channel import LoopLink
from tests.support.local_sockets import LocalSocket
from tests.unit.relay.world import WorldLoop

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]

TEMPORARY = [errno.ETOOMANYREFS, errno.ENOBUFS, errno.ENOMEM]


class Refusing(LocalSocket):
    """A socket of which every write fails with the error `refusal`, if it is not 0."""

    refusal = attempts = 0

    def send(self, *arguments: Any) -> int:
        self._attempt()
        return super().send(*arguments)

    def sendmsg(self, *arguments: Any) -> int:
        self._attempt()
        return super().sendmsg(*arguments)

    def _attempt(self) -> None:
        self.attempts += 1
        if self.refusal:
            raise OSError(self.refusal, os.strerror(self.refusal))


@pytest.fixture
def pair() -> Iterator[tuple[Refusing, Channel]]:
    near, far = socket.socketpair()
    with Refusing(fileno=near.detach()) as sock:
        other = Channel(far, Lifeline)
        yield sock, other
        other.close()


def attached(sock: Refusing) -> Channel:
    end = Channel(sock, Lifeline)
    end.attach(asyncio.get_running_loop(), lambda *_: None, lambda: None)
    return end


def received(other: Channel) -> list[Message]:
    messages = list[Message]()
    for message, descriptors in other.receive():
        messages.append(message)
        for descriptor in descriptors:
            os.close(descriptor)
    return messages


@pytest.mark.parametrize("refusal", TEMPORARY)
async def test_messages_that_the_kernel_refuses_for_a_while_are_sent_later_in_order(
    pair: tuple[Refusing, Channel], refusal: int
) -> None:
    """A timer tries again: no event would, because the socket stays writable."""
    sock, other = pair
    end = attached(sock)
    sock.refusal = refusal
    sent = [SocketKept("first"), Ping(2), SocketKept("third"), Ping(4)]
    for message in sent:
        end.send(message, (other.fileno(),) * message.descriptors)
    at_first = sock.attempts
    await asyncio.sleep(3.5 * AGAIN_SECONDS)
    assert sock.attempts == at_first + 3
    sock.refusal = 0
    await asyncio.sleep(AGAIN_SECONDS)
    assert received(other) == sent
    end.close()


@pytest.mark.parametrize("refusal", TEMPORARY)
def test_a_relay_sends_later_what_the_kernel_refuses_for_a_while(
    pair: tuple[Refusing, Channel], refusal: int
) -> None:
    sock, other = pair
    loop, ended = WorldLoop(), list[str]()
    link = LoopLink(loop, Channel(sock, Lifeline), lambda *_: None, ended.append)
    sock.refusal = refusal
    link.send(Ping(1))
    link.send(Ping(2))
    at_first = sock.attempts
    for _ in range(3):
        loop.turn(AGAIN_SECONDS)
    assert (sock.attempts, ended) == (at_first + 3, [])
    sock.refusal = 0
    loop.turn(AGAIN_SECONDS)
    assert received(other) == [Ping(1), Ping(2)]
    link.close()
    loop.close()


async def test_a_socket_that_is_full_is_written_when_it_is_writable(pair: tuple[Refusing, Channel]) -> None:
    sock, other = pair
    end, began = attached(sock), clock.now()
    sock.refusal = errno.EAGAIN
    end.send(Ping(1))
    sock.refusal = 0
    while end.pending:
        await asyncio.sleep(0)
    assert (received(other), clock.now()) == ([Ping(1)], began)
    end.close()


@pytest.mark.parametrize("error", [errno.EPIPE, errno.EPERM])
async def test_any_other_error_ends_the_stream_for_both_ends(
    pair: tuple[Refusing, Channel], error: int
) -> None:
    """Otherwise a message would be missing between others that arrive."""
    sock, other = pair
    end = attached(sock)
    sock.refusal = error
    end.send(Ping(1))
    assert not end.pending
    with pytest.raises(ChannelClosedError):
        other.receive()
    end.close()


@pytest.mark.parametrize("error", [errno.EPIPE, errno.EPERM])
def test_without_a_loop_any_other_error_is_raised(pair: tuple[Refusing, Channel], error: int) -> None:
    sock, _other = pair
    sock.refusal = error
    with pytest.raises(ChannelClosedError):
        Channel(sock, Lifeline).send(Ping(1))


def test_a_sender_sees_that_the_backlog_grows_before_it_is_full(pair: tuple[Refusing, Channel]) -> None:
    sock, other = pair
    end = Channel(sock, Lifeline, limit=1000)
    sock.refusal = errno.EAGAIN
    seen = []
    with pytest.raises(ChannelFullError):
        for number in range(1000):
            end.send(SocketKept(f"{number:040}"), (other.fileno(),))
            seen.append(end.crowded)
    end.close()
    assert (seen[0], seen[-1]) == (False, True)
    assert 0.4 < seen.count(False) / len(seen) < 0.6
