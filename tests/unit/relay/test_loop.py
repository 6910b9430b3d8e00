"""The event loop: descriptors and timers."""

import socket
from collections.abc import Iterator

import pytest

from appliance.relay.loop import READ, Loop


@pytest.fixture
def loop() -> Iterator[Loop]:
    """A loop that is closed."""
    loop = Loop()
    yield loop
    loop.close()


def test_a_handler_is_not_called_for_what_was_discarded_in_the_same_turn(loop: Loop) -> None:
    """Whichever of two ready sockets comes first closes the other, and the other's handler never runs."""
    pairs = [socket.socketpair() for _ in range(2)]
    called = []
    for index in range(2):

        def handle(_events: int, index: int = index) -> None:
            called.append(index)
            loop.discard(pairs[1 - index][0])

        loop.watch(pairs[index][0].fileno(), READ, handle)
        pairs[index][1].send(b"x")
    loop.turn(1)
    assert len(called) == 1
    assert pairs[1 - called[0]][0].fileno() == -1
    for pair in pairs:
        for sock in pair:
            sock.close()


def test_timers_run_in_order_and_cancelled_ones_never(loop: Loop) -> None:
    """By their time, and in the order they were set for the same time."""
    now = 0.0
    loop.clock = lambda: now
    ran: list[str] = []
    loop.after(2, lambda: ran.append("second"))
    loop.after(1, lambda: ran.append("first"))
    loop.after(2, lambda: ran.append("third"))
    loop.after(1, lambda: ran.append("never")).cancel()
    now = 1.5
    loop.turn(0)
    assert ran == ["first"]
    now = 3
    loop.turn(0)
    assert ran == ["first", "second", "third"]


def test_stop_ends_run_after_the_turn(loop: Loop) -> None:
    """From a timer as from a handler."""
    loop.after(0, loop.stop)
    loop.run()
