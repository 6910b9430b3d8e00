import contextlib
import socket
from collections.abc import Callable
from itertools import product

import pytest

from appliance.channel.messages import FlowLimit
from appliance.relay.connections.subscriber import Subscriber, describe_mismatch
from appliance.relay.loop import EventLoop
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.rate_limit import SharedRateLimit
from tests.unit.relay.connections.test_relayed_topic import HEADER, Story, batch
from tests.unit.relay.contexts import context_of

OFFERED = {"type": "std_msgs/String", "md5sum": "aaa"}


@pytest.mark.parametrize(
    "wanted",
    [
        {"type": "std_msgs/String", "md5sum": "aaa"},
        {"type": "*", "md5sum": "*"},
        {"type": "other/Same", "md5sum": "aaa"},
        {"md5sum": "*"},
    ],
)
def test_the_md5sum_decides_and_an_asterisk_fits_all(wanted: dict[str, str]) -> None:
    assert describe_mismatch(wanted, OFFERED) == ""
    assert describe_mismatch(wanted | {"md5sum": "bbb"}, OFFERED | {"md5sum": "*"}) == ""


def test_a_mismatch_names_both_sides() -> None:
    assert describe_mismatch({"type": "std_msgs/Int32", "md5sum": "b"}, OFFERED) == (
        "topic types do not match: [std_msgs/Int32] vs. [std_msgs/String]"
    )
    text = describe_mismatch(
        {"type": "std_msgs/String", "md5sum": "b", "callerid": "/l", "topic": "/t"}, OFFERED
    )
    assert "[/l] wants topic [/t]" in text
    assert "[std_msgs/String/b]" in text
    assert "[std_msgs/String/aaa]" in text


class Display:
    """A subscriber of a latching publisher over a real connection."""

    def __init__(self) -> None:
        self.loop = EventLoop()
        context = context_of(self.loop, named_hosts=("10.0.0.2",))
        self.memory = context.memory.queues.of("10.0.0.2")
        self.story = Story("/map")
        self.story.topic.upstream_opened(HEADER | {"latching": "1"})
        ours, self.peer = socket.socketpair()
        ours.setblocking(False)
        self.peer.setblocking(False)
        fields = {"callerid": "/rviz", "topic": "/map", "md5sum": "m", "type": "std_msgs/String"}
        self.member = Subscriber(
            context, ours, self.story.topic, "10.0.0.2", fields,
            refuse=lambda *_given: None, ended=lambda _member: None,
        )  # fmt: skip

    def read(self) -> bytes:
        data = b""
        for _ in range(200):
            self.loop.turn(0.0)
            with contextlib.suppress(BlockingIOError):
                data += self.peer.recv(1 << 20)
        return data

    def tidy(self) -> None:
        for _second in range(3):
            self.story.now += 1
            self.story.topic.tidy()

    def close(self) -> None:
        self.member.cut("")
        self.loop.turn(0.0)
        self.peer.close()
        self.loop.close()


def masked(display: Display) -> Callable[[], None]:
    display.story.topic.withhold(lambda _host: True)
    return lambda: display.story.topic.withhold(None)


def limited(display: Display) -> Callable[[], None]:
    limit = SharedRateLimit(FlowLimit(messages=0.001), display.loop.clock()).of("")
    limit.take(batch(b"1", b"2", b"3"))
    display.member.limit(limit)
    return lambda: display.member.limit(None)


def no_memory(display: Display) -> Callable[[], None]:
    display.memory.add(128 << 20)
    return lambda: display.memory.add(-(128 << 20))


def slow(display: Display) -> Callable[[], None]:
    """Let the message wait in the queue, from which it is dropped once the host has no memory."""
    with contextlib.suppress(BlockingIOError):
        while True:
            display.member._socket.send(b"x" * (1 << 16))
    free = no_memory(display)

    def read() -> None:
        display.read()
        free()

    return read


@pytest.mark.real
def test_a_subscriber_that_missed_a_latched_message_gets_it_once_the_cause_has_ended() -> None:
    for cause, early, size in product((masked, limited, no_memory, slow), (True, False), (100, 4 << 20)):
        with contextlib.closing(Display()) as display:
            seen = latched_seen(display, cause, batch(b"m" * size), early=early)
        # of the connection, so the queue is not needed
        has_room = cause is no_memory and size == 100
        assert seen == (int(has_room), 1), (cause, early, size)


def latched_seen(
    display: Display, cause: Callable[[Display], Callable[[], None]], latched: Batch, *, early: bool
) -> tuple[int, int]:
    """Count the message before and after the end of the cause. The subscriber is there `early`, or comes after it."""
    topic = display.story.topic
    if early:
        topic.join(display.member)
        display.read()
        end = cause(display)
        display.story.receive(latched)
    else:
        display.story.receive(latched)
        end = cause(display)
        topic.join(display.member)
    display.tidy()
    before = got = b"" if cause is slow else display.read()
    end()
    for _ in range(3):
        display.tidy()
        got += display.read()
    return before.count(bytes(latched.view)), got.count(bytes(latched.view))
