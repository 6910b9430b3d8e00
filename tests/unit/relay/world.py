"""An engine that talks to peers on loopback. Tests give control's messages and the peers' bytes, and get the answers.

The engine runs in the test's own thread, with local sockets and in virtual time. Every step lets the loop turn until
the expected event has happened.
"""

import contextlib
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from appliance.base import clock
from appliance.channel.channel import Channel
from appliance.channel.messages import (
    ClientGranted,
    GrantInstalled,
    Message,
    NodePlaced,
    PublicationPlaced,
    RelayLink,
    ServicePlaced,
    UpstreamFound,
    UpstreamWanted,
)
from appliance.relay.data_plane import DataPlane
from appliance.relay.loop import EventLoop, WorkBeside
from appliance.relay.relay_limits import MIB, RelayLimits
from appliance.relay.transport.loop_channel import LoopLink
from roswire.tcpros import HeaderParser, encode_header
from tests.support.processes import LIMIT
from tests.support.virtual_clock import VirtualClock, let_time_pass

T = TypeVar("T")
LOOPBACK = "127.0.0.1"
LIMITS = replace(
    RelayLimits(grant_seconds=30.0, header_seconds=30.0, connect_seconds=30.0, service_seconds=30.0),
    message_bytes=4 * MIB,
    queue_messages=50,
    queue_bytes=8 * MIB,
    linger=0.2,
    farewell=0.2,
    retry_first=0.02,
    report_every=0.1,
    connections=20,
    connections_per_host=15,
)
IMPATIENT = replace(LIMITS, header_seconds=0.3, grant_seconds=0.1, connect_seconds=1.0, service_seconds=1.0)
"""Short limits, only for tests of these limits: on a busy machine any step may take longer."""
UNHURRIED = replace(LIMITS, linger=3600.0)
HEADER = {
    "callerid": "/talker",
    "type": "std_msgs/String",
    "md5sum": "m",
    "latching": "0",
    "topic": "/chatter",
}
ASK = {"callerid": "/listener", "topic": "/chatter", "type": "std_msgs/String", "md5sum": "m"}
CALL = {"callerid": "/client", "service": "/mode", "md5sum": "*"}
SERVED = {"callerid": "/talker", "type": "x/Y", "md5sum": "m"}


class Peer:
    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self.data = bytearray()
        self.ended = False

    def send(self, data: bytes) -> None:
        with contextlib.suppress(
            BrokenPipeError
        ):  # over TCP, the kernel takes a first message for an end that is gone
            self.sock.send(data)

    def read(self) -> None:
        while not self.ended:
            try:
                data = self.sock.recv(1 << 20)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            self.data += data
            self.ended = not data

    def header(self) -> dict[str, str] | None:
        parser = HeaderParser()
        fields = parser.feed(bytes(self.data))
        if fields is not None:
            self.data = bytearray(parser.rest)
        return fields

    def reset(self) -> None:
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.sock.close()


class HeldWork:
    def __init__(self, do: Callable[[], None]) -> None:
        self.do: Callable[[], None] | None = do

    def discard(self) -> None:
        self.do = None


class WorldLoop(EventLoop):
    """A loop that does background work in its next turn, without a thread, unless the test `holds` it.

    Time passes while nothing is ready.
    """

    holds = False

    def __init__(self) -> None:
        self._is_virtual = isinstance(clock.source(), VirtualClock)  # not in nightly tests
        super().__init__(time.thread_time_ns)

    def turn(self, longest: float) -> None:
        if not self._is_virtual:
            super().turn(longest)
            return
        if not self._waiting and not self._epoll.poll(0, 1):
            until_timer = self._timers[0][0] - self.clock() if self._timers else longest
            let_time_pass(max(0.0, min(longest, until_timer)) + 1e-9)
        super().turn(0)

    def beside(self, work: Callable[[], T], done: Callable[[T], None]) -> WorkBeside:
        self._work = HeldWork(lambda: done(work()))
        self.after(0, self._do)
        return self._work

    def release(self) -> None:
        self.holds = False
        self.after(0, self._do)

    def _do(self) -> None:
        do = self._work.do
        if do is not None and not self.holds:
            self._work.discard()
            do()


class World:
    """An engine with a control, and a node `/talker` (key `k`) that publishes /chatter and offers /mode."""

    def __init__(self, limits: RelayLimits = LIMITS) -> None:
        self.loop = WorldLoop()
        self.engine = DataPlane(self.loop, limits)
        self.told: list[Any] = []
        self.open: list[socket.socket] = []
        self.publisher = self.listen()
        self.service = self.listen()
        self.port = self.listen()
        self.connect_control()
        self.state(NodePlaced("k", "/talker", LOOPBACK), self.port)
        self.state(PublicationPlaced("k", "/chatter", "*"))
        self.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
        self.state(ServicePlaced("k", "/mode", LOOPBACK, self.service.getsockname()[1]))
        self.state(ClientGranted("k", "/mode", LOOPBACK, "/client"))

    def connect_control(self) -> None:
        ours, theirs = socket.socketpair()
        self.control = Channel(ours, RelayLink)
        self.link = LoopLink(self.loop, Channel(theirs, RelayLink), self.engine.take, lambda _reason: None)
        self.engine.attach(self.link)

    def listen(self) -> socket.socket:
        sock = socket.create_server((LOOPBACK, 0))
        sock.setblocking(False)
        self.open.append(sock)
        return sock

    @property
    def held(self) -> int:
        return sum(size for what, size in self.engine.memory.bytes_held().items() if what != "headers")

    def state(self, message: Message, *sockets: socket.socket) -> None:
        self.control.send(message, tuple(sock.fileno() for sock in sockets))
        self.link.catch_up()

    def until(self, condition: Callable[[], Any], seconds: float = LIMIT) -> Any:
        deadline = clock.now() + seconds
        while True:
            self.loop.turn(0.01)
            self.told += [message for message, _fds in self.control.receive()]
            found = condition()
            if found:
                return found
            assert clock.now() < deadline, f"not within {seconds} s; control was told {self.told[-10:]}"

    def hears(self, kind: type[Message], **fields: Any) -> Any:
        def find() -> Any:
            for message in self.told:
                if isinstance(message, kind) and all(getattr(message, k) == v for k, v in fields.items()):
                    return message
            return None

        found = self.until(find)
        self.told.remove(found)
        return found

    def connect(self, *parts: bytes, host: str = LOOPBACK, port: socket.socket | None = None) -> Peer:
        where = (LOOPBACK, (port or self.port).getsockname()[1])
        peer = Peer(socket.create_connection(where, source_address=(host, 0)))
        self.open.append(peer.sock)
        for part in parts:
            peer.send(part)
        return peer

    def push(self, peer: Peer, data: bytes) -> None:
        try:
            self.pour(peer, data)
        except ConnectionError as error:
            raise AssertionError(f"the relay closed it, and said {self.told[-5:]}") from error

    def pour(self, peer: Peer, data: bytes) -> None:
        rest, deadline = memoryview(data), clock.now() + LIMIT
        while rest:
            try:
                rest = rest[peer.sock.send(rest[:MIB]) :]
            except BlockingIOError:
                assert clock.now() < deadline, "the relay reads no more"
                self.loop.turn(0.01)
            self.loop.turn(0)

    def accept(self, listening: socket.socket) -> Peer:
        def take() -> Peer | None:
            try:
                return Peer(listening.accept()[0])
            except BlockingIOError:
                return None

        peer: Peer = self.until(take)
        self.open.append(peer.sock)
        return peer

    def gets_header(self, peer: Peer) -> dict[str, str]:
        def find() -> dict[str, str] | None:
            peer.read()
            return peer.header()

        fields: dict[str, str] = self.until(find)
        return fields

    def gets(self, peer: Peer, data: bytes) -> None:
        def whole() -> bool:
            peer.read()
            return len(peer.data) >= len(data)

        self.until(whole)
        assert peer.data == data
        peer.data.clear()

    def ends(self, peer: Peer) -> bytes:
        def ended() -> bool:
            peer.read()
            return peer.ended

        self.until(ended)
        return bytes(peer.data)

    def upstream(
        self, header: dict[str, str] = HEADER, md5sum: str = "*", *, key: str = "k", behind: bytes = b""
    ) -> Peer:
        """Let the publisher of the topic answer the relay with `header`, and send what is `behind` it at once."""
        topic = header.get("topic", "/chatter")
        self.hears(UpstreamWanted, key=key, topic=topic)
        self.state(UpstreamFound(key, topic, LOOPBACK, self.publisher.getsockname()[1]))
        peer = self.accept(self.publisher)
        asked = self.gets_header(peer)
        assert (asked["topic"], asked["md5sum"], asked["callerid"]) == (topic, md5sum, "/rosrv")
        peer.send(encode_header(header) + behind)
        return peer

    def subscribed(self, header: dict[str, str] = HEADER) -> tuple[Peer, Peer]:
        """Connect a subscriber and the publisher with `header`."""
        subscriber = self.connect(encode_header(ASK))
        publisher = self.upstream(header)
        assert self.gets_header(subscriber) == header
        return publisher, subscriber

    def call(self, header: dict[str, str] = SERVED, **fields: str) -> tuple[Peer, Peer]:
        """Connect a client, with these `fields` beside those of `CALL`, and the service with `header`."""
        client = self.connect(encode_header(CALL | fields))
        service = self.accept(self.service)
        self.gets_header(service)
        service.send(encode_header(header))
        assert self.gets_header(client)["md5sum"] == header["md5sum"]
        return client, service

    def close(self) -> None:
        self.engine.close()
        self.link.close()
        self.loop.close()
        self.control.close()
        for sock in self.open:
            sock.close()
