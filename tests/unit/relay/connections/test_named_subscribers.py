import contextlib
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from appliance.relay.connections.named_subscribers import Greeting, NamedSubscribers, looks_for_names
from appliance.relay.loop import EventLoop
from appliance.relay.relay_limits import MIB, RelayLimits
from roswire.tcpros import HeaderParser, encode_frame, encode_header
from tests.unit.relay.contexts import context_of

GOAL = "actionlib_tutorials/FibonacciActionGoal"
TOPIC = "/fibonacci/goal"
ACCEPTED = {"type": "a/FibonacciActionGoal", "md5sum": "*"}


@pytest.fixture
def loop() -> Iterator[EventLoop]:
    loop = EventLoop()
    yield loop
    loop.close()


@pytest.fixture
def publisher() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.settimeout(0.01)
        yield sock


@pytest.fixture
def presences(loop: EventLoop) -> Iterator[NamedSubscribers]:
    presences = NamedSubscribers(context_of(loop), TOPIC, "10.0.0.9")
    yield presences
    presences.close()


def turn_until(loop: EventLoop, done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not done():
        assert time.monotonic() < deadline, "it did not happen"
        loop.turn(0.01)


def accept(loop: EventLoop, publisher: socket.socket) -> tuple[socket.socket, dict[str, str]]:
    found: list[tuple[socket.socket, dict[str, str]]] = []
    parser, connections = HeaderParser(65536), list[socket.socket]()

    def arrived() -> bool:
        try:
            if not connections:
                connections.append(publisher.accept()[0])
                connections[0].settimeout(0.01)
            header = parser.feed(connections[0].recv(4096))
        except TimeoutError:
            return False
        if header is not None:
            found.append((connections[0], header))
        return bool(found)

    turn_until(loop, arrived)
    return found[0]


def ended(sock: socket.socket) -> bool:
    try:
        return sock.recv(4096) == b""
    except TimeoutError:
        return False


@pytest.mark.nightly
def test_each_subscriber_is_seen_under_its_own_name_and_goes_when_it_leaves(
    loop: EventLoop, presences: NamedSubscribers, publisher: socket.socket
) -> None:
    presences.open(publisher.getsockname(), ACCEPTED)
    presences.announce(lambda: frozenset({"/one", "/other"}), GOAL)
    seen = dict(
        sorted((header["callerid"], sock) for sock, header in (accept(loop, publisher) for _ in "ab"))
    )
    assert list(seen) == ["/one", "/other"]
    presences.announce(lambda: frozenset({"/other"}), GOAL)
    turn_until(loop, lambda: ended(seen["/one"]))
    assert not ended(seen["/other"])
    for sock in seen.values():
        sock.close()


@pytest.mark.nightly
def test_a_presence_that_breaks_is_made_again(
    loop: EventLoop, presences: NamedSubscribers, publisher: socket.socket
) -> None:
    presences.open(publisher.getsockname(), ACCEPTED)
    presences.announce(lambda: frozenset({"/one"}), GOAL)
    first, _header = accept(loop, publisher)
    first.close()
    second, header = accept(loop, publisher)
    assert (header["callerid"], header["topic"], header["md5sum"]) == ("/one", TOPIC, "*")
    second.close()


@pytest.mark.parametrize(
    ("type_name", "named"),
    [
        (GOAL, True),
        ("actionlib_msgs/GoalID", True),
        ("actionlib_msgs/GoalStatusArray", False),
        ("std_msgs/String", False),
    ],
)
def test_only_the_topics_of_actions_need_names(type_name: str, named: bool) -> None:
    assert looks_for_names(type_name) is named


@pytest.mark.nightly
@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15, 0.5, 1.0, 1.8])
@pytest.mark.parametrize("number", [1, 3])
def test_a_greeting_may_come_within_two_seconds(
    loop: EventLoop, publisher: socket.socket, delay: float, number: int
) -> None:
    ended: list[bytes] = []
    context = context_of(loop, named_hosts=("10.0.0.9",))
    Greeting(context, "10.0.0.9", publisher.getsockname(), {"callerid": "/rosrv", **ACCEPTED}, ended.append)
    sock, _header = accept(loop, publisher)
    sock.send(encode_header(ACCEPTED))
    frames, sent = encode_frame(b"map") * number, loop.clock() + delay

    def over() -> bool:
        nonlocal frames
        if frames and loop.clock() >= sent:
            sock.send(frames)
            frames = b""
        return bool(ended)

    turn_until(loop, over)
    assert ended == [encode_frame(b"map") * number]
    assert loop.clock() - sent < 1
    sock.close()


@pytest.mark.nightly
@pytest.mark.parametrize("sent", [b"", b"map", b"a long map", b"torn", b"too long", b"closed"])
def test_a_greeting_is_what_comes_at_once(loop: EventLoop, publisher: socket.socket, sent: bytes) -> None:
    ended: list[bytes] = []
    limits = RelayLimits(memory_bytes=MIB) if sent == b"too long" else RelayLimits()
    context = context_of(loop, limits, named_hosts=("10.0.0.9",))
    Greeting(context, "10.0.0.9", publisher.getsockname(), {"callerid": "/rosrv", **ACCEPTED}, ended.append)
    sock, header = accept(loop, publisher)
    assert header["callerid"] == "/rosrv"
    frame = encode_frame(sent * (MIB if sent in {b"a long map", b"too long"} else 1)) if sent else b""
    sock.setblocking(False)
    data = encode_header(ACCEPTED) + (frame[:-1] if sent == b"torn" else frame)

    def over() -> bool:
        nonlocal data
        with contextlib.suppress(BlockingIOError, ConnectionError):
            data = data[sock.send(data) :] if data else data
        if sent == b"closed":
            sock.close()
        return bool(ended)

    turn_until(loop, over)
    assert ended == [frame if sent in {b"map", b"a long map"} else b""]
    assert context.memory.frames.of("10.0.0.9").used == 0
    sock.close()
