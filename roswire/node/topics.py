"""The topics of a node: subscriptions that follow publishers, and publications with a queue for each subscriber.

A publisher never waits for a subscriber. Instead, the oldest waiting messages are dropped and counted.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

from roswire.counted import counted
from roswire.errors import LimitExceededError, ProtocolError, RosError
from roswire.node.network import ByteWriter, NodeMemory, NodeNetwork, OwnedTasks
from roswire.node.tcpros_receiver import TcprosReceiver
from roswire.node.tcpros_streams import (
    ANY,
    MessageType,
    NodeLimits,
    refuse,
    require_accepted,
)
from roswire.node.xmlrpc_http import CALL_LIMITS, call_xmlrpc
from roswire.tcpros import HEADER_LIMIT, Body, decode_header, encode_frame, encode_header
from roswire.uris import parse_node_uri

Received = Callable[[Body, Mapping[str, str]], None]
"""Takes the bytes of a message, and the connection header of its publisher."""

_FIRST_PAUSE = (
    0.1  # seconds between two attempts to reach a publisher; the pause doubles up to the second number
)
_LONGEST_PAUSE = 5.0
_OVERHEAD = 64  # bytes that a waiting frame takes besides its own


class OwnMemory:
    """A `NodeMemory` of at most `most` bytes for one node."""

    def __init__(self, most: int) -> None:
        self._most = most
        self.held = 0

    def add(self, size: int) -> None:
        self.held += size

    def refusal(self, size: int) -> str:
        held = self.held + size
        return f"the node would hold {held} bytes; at most {self._most}" if held > self._most else ""


@dataclass(frozen=True, slots=True)
class NodeLink:
    """The parts of a node that its topics and services use.

    Large frames take memory from `arriving` until they are complete. `skipped` is called for each that finds none.
    """

    name: str
    network: NodeNetwork
    limits: NodeLimits
    queues: "SendQueues"
    arriving: NodeMemory
    skipped: Callable[[], None]


class NodeSubscription:
    """A subscription with one connection for each publisher, which is reopened whenever it ends.

    `problems` has the reason for each publisher that cannot be reached.
    """

    def __init__(self, link: NodeLink, topic: str, wanted: MessageType, received: Received) -> None:
        self.topic = topic
        self.wanted = wanted
        self.problems: dict[str, str] = {}
        self.connected: dict[str, Mapping[str, str]] = {}  # the header of each publisher that is connected
        self.updates = 0  # how many lists of publishers came
        self._connection = asyncio.Event()
        self._link = link
        self._received = received
        self._tasks = OwnedTasks()
        self._followed: dict[str, asyncio.Task[None]] = {}
        self._latest: dict[
            str, tuple[int, int]
        ] = {}  # number and checksum of each latched publisher's last message

    def update(self, uris: Sequence[str]) -> None:
        """Connect to the publishers in the list, and disconnect from all others."""
        self.updates += 1
        wanted = dict.fromkeys(uris[: self._link.limits.publishers])
        for uri in [uri for uri in self._followed if uri not in wanted]:
            self._followed.pop(uri).cancel()
            self.problems.pop(uri, None)
        for uri in wanted:
            if uri not in self._followed:
                self._followed[uri] = self._tasks.start(self._follow(uri))
        self._connection.set()

    async def headers(self, seconds: float) -> list[Mapping[str, str]]:
        """Return the headers of the publishers, once all are connected or after some seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while len(self.connected) < len(self._followed):
                    self._connection.clear()
                    await self._connection.wait()
        return [*self.connected.values()]

    def hear_own(self, body: Body, header: Mapping[str, str]) -> None:
        """Receive a message of this node's own publication, unless it has another type."""
        if self.wanted.md5sum in (ANY, header["md5sum"]):
            self._received(body, header)

    async def close(self) -> None:
        self._followed.clear()
        await self._tasks.close()

    async def _follow(self, uri: str) -> None:
        pause = _FIRST_PAUSE
        while True:
            before = asyncio.get_running_loop().time()
            try:
                await self._receive(uri)
            except (RosError, OSError) as error:
                self.problems[uri] = str(error) or f"{uri} did not answer in time"
            finally:
                self.connected.pop(uri, None)
                self._latest.pop(uri, None)
            if asyncio.get_running_loop().time() - before > _LONGEST_PAUSE:  # it was connected for a while
                pause = _FIRST_PAUSE
            await asyncio.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE)

    async def _receive(self, uri: str) -> None:
        async with self._connection_to(uri) as (receiver, header):
            self.connected[uri] = header
            self._connection.set()
            self.problems.pop(uri, None)
            latched = header.get("latching") == "1"

            def receive(body: Body) -> None:
                if latched:
                    self._latest[uri] = self._latest.get(uri, (0, 0))[0] + 1, crc32(body)
                self._received(body, header)

            await receiver.deliver_to(receive, self._link.limits.message_bytes)

    @contextlib.asynccontextmanager
    async def _connection_to(self, uri: str) -> AsyncIterator[tuple[TcprosReceiver, Mapping[str, str]]]:
        host, port = await self._request_topic(uri)
        limits = self._link.limits
        receiver = TcprosReceiver(self._link.arriving, self._link.skipped)
        async with asyncio.timeout(limits.call_seconds):
            await self._link.network.receive(host, port, receiver)
        try:
            fields = {
                "callerid": self._link.name,
                "topic": self.topic,
                "type": self.wanted.name,
                "md5sum": self.wanted.md5sum,
                "message_definition": self.wanted.definition,
                "tcp_nodelay": "1",
            }
            receiver.write(encode_header(fields))
            async with asyncio.timeout(limits.header_seconds):
                header = require_accepted(decode_header(bytes(await receiver.next(HEADER_LIMIT))))
            self._check(uri, header)
            yield receiver, header
        finally:
            receiver.close()

    def repeat(self, received: Received) -> None:
        """Give `received` the last message of each latched publisher, which sends it over an additional connection.

        A message that the present connection delivers at the same time or later is not given twice.
        """
        for uri in [uri for uri, header in self.connected.items() if header.get("latching") == "1"]:
            self._tasks.start(self._repeat(uri, received))

    async def _repeat(self, uri: str, received: Received) -> None:
        before = self._latest.get(uri)
        with contextlib.suppress(RosError, OSError):
            async with (
                asyncio.timeout(self._link.limits.call_seconds),
                self._connection_to(uri) as (receiver, header),
            ):
                body = await receiver.next(self._link.limits.message_bytes)
                latest = self._latest.get(uri)
                if latest is not None and latest == before and latest[1] == crc32(body):
                    received(body, header)

    def _check(self, uri: str, header: Mapping[str, str]) -> None:
        md5sum = header.get("md5sum", "")
        if self.wanted.md5sum not in (ANY, md5sum):
            raise ProtocolError(
                f"{uri} publishes {header.get('type', '')[:200]} with the md5sum {md5sum[:32]}; "
                f"{self.wanted.name} has {self.wanted.md5sum}"
            )

    async def _request_topic(self, uri: str) -> tuple[str, int]:
        link = self._link
        answer = await call_xmlrpc(
            link.network,
            parse_node_uri(uri),
            "requestTopic",
            (link.name, self.topic, [["TCPROS"]]),
            seconds=link.limits.call_seconds,
            limits=CALL_LIMITS,
        )
        match answer:
            case [1, str(), ["TCPROS", str(host), int(port)]] if 0 < port < 65536:
                return host, port
            case [_, str(text), *_]:
                raise ProtocolError(f"{uri} does not serve {self.topic}: {text[:300]}")
        raise ProtocolError(f"{uri} gave no valid answer to requestTopic")


class NodePublication:
    """A publication. At most `queue` messages wait for each subscriber; `dropped` counts the lost ones.

    A latched publication sends its last message to each new subscriber. Subscribers connect some time after the
    registration, so those that connect within `replay` seconds get all messages until then. `own` returns the node's
    own subscription, which gets the messages without a connection, as with rospy and roscpp.
    """

    def __init__(
        self,
        link: NodeLink,
        topic: str,
        kind: MessageType,
        *,
        latched: bool,
        queue: int,
        replay: float,
        own: Callable[[], NodeSubscription | None],
    ) -> None:
        if queue < 1:
            raise ValueError(f"a queue of {counted(queue, 'message')}; give at least 1")
        self.topic = topic
        self.type = kind
        self.latched = latched
        self._link = link
        self._own = own
        self._header = {
            "callerid": link.name,
            "topic": topic,
            "type": kind.name,
            "md5sum": kind.md5sum,
            "message_definition": kind.definition,
            "latching": str(int(latched)),
        }
        self._queue = queue
        self._replay = replay
        self._kept = _SendQueue(
            "", 1 if latched else queue, link.queues, pinned=latched
        )  # for later subscribers
        self._forget: asyncio.TimerHandle | None = None
        self.replay_from_now()
        self._served: set[_SendQueue] = set()
        self._dropped = 0  # for subscribers that have left
        self._tasks = OwnedTasks()

    @property
    def subscribers(self) -> list[str]:
        return [one.name for one in self._served]

    @property
    def dropped(self) -> int:
        return self._dropped + sum(one.dropped for one in self._served)

    def publish(self, body: bytes) -> None:
        """Send a message to all subscribers. Raise `LimitExceededError` if a latched message cannot be kept."""
        stays = self.latched or self._replays()
        frame = encode_frame(body) if self._served or stays else b""
        if stays:
            self._kept.put(frame)
        for one in self._served:
            one.put(frame)
        if (own := self._own()) is not None:
            own.hear_own(body, self._header)

    def repeat(self, received: Received) -> None:
        """Give `received` the last message of a latched publication."""
        if self.latched:
            for frame in self._kept.frames:
                received(frame[4:], self._header)  # without its length

    def replay_from_now(self) -> None:
        loop = asyncio.get_running_loop()
        self._kept.clear()
        self._replay_until = loop.time() + self._replay
        if self._forget is not None:
            self._forget.cancel()
        self._forget = None if self.latched else loop.call_later(self._replay, self._kept.clear)

    def _replays(self) -> bool:
        return asyncio.get_running_loop().time() < self._replay_until

    async def serve(
        self, reader: asyncio.StreamReader, writer: ByteWriter, header: Mapping[str, str]
    ) -> None:
        if header.get("md5sum") not in (ANY, self.type.md5sum):
            refuse(
                writer,
                f"{self.topic} has the type {self.type.name} with the md5sum {self.type.md5sum}; the subscriber "
                f"wants {header.get('type', '')[:200]} with {header.get('md5sum', '')[:32]}",
            )
            return
        writer.write(encode_header(self._header))
        queue = _SendQueue(header.get("callerid", "")[:200], self._queue, self._link.queues)
        if self.latched or self._replays():
            for frame in [*self._kept.frames]:
                queue.put(frame)
        self._served.add(queue)
        sending = self._tasks.start(queue.send_to(writer))
        try:
            await reader.read(
                1
            )  # a subscriber sends nothing after its header: this is the end of the connection
        finally:
            self._served.discard(queue)
            sending.cancel()
            writer.close()
            queue.close()
            self._dropped += queue.dropped

    async def close(self) -> None:
        if self._forget is not None:
            self._forget.cancel()
        self._kept.close()
        await self._tasks.close()


class SendQueues:
    """All messages of a node that wait for other nodes. They share a memory."""

    def __init__(self, memory: NodeMemory) -> None:
        self.memory = memory
        self.queues: set[_SendQueue] = set()

    def make_room(self, own: "_SendQueue", size: int) -> str:
        """Drop messages until `own` has room for one of this size, or return the reason why it gets none.

        The longest queue loses its oldest message first, so a queue drops messages of others only until it would be
        the longest itself. A pinned queue drops those of others in any case.
        """
        claim = 0 if own.pinned else own.bytes + size
        wanted = size - own.bytes if own.pinned else size  # a pinned message is replaced
        while reason := self.memory.refusal(wanted):
            longest = max(
                (queue for queue in self.queues if queue.frames), key=lambda queue: queue.bytes, default=None
            )
            if longest is None or (claim >= longest.bytes and not own.frames):
                return reason
            (own if claim >= longest.bytes else longest).drop_oldest()
            claim = 0 if own.pinned else own.bytes + size
        return ""


class _SendQueue:
    """The messages that wait for one subscriber, or for later ones. A pinned queue loses none to others."""

    def __init__(self, name: str, most: int, queues: SendQueues, *, pinned: bool = False) -> None:
        self.name = name
        self.frames: deque[bytes] = deque()
        self.bytes = 0  # also of the message that is being sent
        self.dropped = 0
        self.pinned = pinned
        self._most = most
        self._queues = queues
        self._ready = asyncio.Event()
        if not pinned:
            queues.queues.add(self)

    def put(self, frame: bytes) -> None:
        """Add a message, for which older ones make room. If they cannot, drop it.

        Raise `LimitExceededError` instead if the queue is pinned.
        """
        size = _held(frame)
        reason = self._queues.make_room(self, size)
        if reason and self.pinned:
            raise LimitExceededError(f"no memory to keep a latched message of {len(frame)} bytes: {reason}")
        if reason:
            self.dropped += 1
            return
        self.frames.append(frame)
        self._charge(size)
        while len(self.frames) > self._most:
            self.drop_oldest()
        self._ready.set()

    def drop_oldest(self) -> None:
        self._charge(-_held(self.frames.popleft()))
        self.dropped += 1

    def _charge(self, size: int) -> None:
        self.bytes += size
        self._queues.memory.add(size)

    def clear(self) -> None:
        while self.frames:
            self._charge(-_held(self.frames.popleft()))

    def close(self) -> None:
        self.clear()
        self._queues.queues.discard(self)

    async def send_to(self, writer: ByteWriter) -> None:
        try:
            while True:
                await self._ready.wait()
                self._ready.clear()
                while self.frames:
                    frame = self.frames.popleft()
                    try:
                        writer.write(frame)
                        await writer.drain()
                    finally:
                        self._charge(-_held(frame))  # until here, the connection holds it
        except OSError:
            writer.close()


def _held(frame: bytes) -> int:
    return len(frame) + _OVERHEAD
