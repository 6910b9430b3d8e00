"""Extra connections to a publisher: for its subscribers' names, and for its greeting of a new subscriber.

Only action topics need names. An action client waits until *its server* subscribes to its goals and cancellations, and
recognizes the server by the `callerid` of the status messages (actionlib, `wait_for_server`). An extra connection opens
after the relay has begun to serve the subscriber, which so misses nothing that the publisher sends from then on.

Some publishers send a message to each new subscriber alone, from their connect callback (costmap_2d). `Greeting` opens
a connection for a short time, and returns what comes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial

from appliance.relay.connections.served_subscribers import TopicSubscriber
from appliance.relay.context import RelayContext
from appliance.relay.loop import LoopTimer
from appliance.relay.transport.memory import HeldBytes
from appliance.relay.transport.pump import walk
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header

_GOAL = "ActionGoal"
_CANCEL = "actionlib_msgs/GoalID"
_RETRY_SECONDS = 1.0
_GREETING_SECONDS = 2.0  # after the header, for the first message: some publishers greet in their own rhythm
_SILENT_SECONDS = 0.1  # after the first bytes, or since the last ones of an unfinished message
_GREETING_MESSAGES = 200  # more than the publishers of one topic in a node, each of which latches one
_SEEN_OF_A_HOST = 16  # subscribers of a host that a publisher may see by name, over one connection each


def looks_for_names(type_name: str) -> bool:
    return type_name.endswith(_GOAL) or type_name == _CANCEL


def seen_names(members: Iterable[TopicSubscriber], servers: Collection[str]) -> frozenset[str]:
    """Return the names of subscribers that a publisher sees, with those served by `servers` first."""
    of_host: dict[str, set[str]] = {}
    for member in sorted(members, key=lambda member: member.caller_id not in servers):
        names = of_host.setdefault(member.host, set())
        if len(names) < _SEEN_OF_A_HOST:
            names.add(member.caller_id)
    return frozenset().union(*of_host.values())


class ActionServers:
    """The nodes that publish the status of an action, by action."""

    def __init__(self) -> None:
        self._names: dict[str, dict[str, str]] = {}

    def add(self, key: str, topic: str, name: str) -> list[str]:
        action, _, last = topic.rpartition("/")
        if last != "status":
            return []
        self._names.setdefault(action, {})[key] = name
        return [f"{action}/goal", f"{action}/cancel"]

    def remove(self, key: str, topic: str) -> None:
        action, _, last = topic.rpartition("/")
        if last == "status" and action in self._names:
            self._names[action].pop(key, None)
            if not self._names[action]:
                del self._names[action]

    def of(self, topic: str) -> Collection[str]:
        return self._names.get(topic.rpartition("/")[0], {}).values()


class NamedSubscribers:
    """The extra connections to one publisher of one topic. Messages on them are discarded, except greetings."""

    def __init__(self, context: RelayContext, topic: str, host: str) -> None:
        self._context = context
        self._topic = topic
        self._host = host
        self._wanted: frozenset[str] = frozenset()
        self._address: tuple[str, int] | None = None
        self._accepted: Mapping[str, str] = {}
        self._streams: dict[str, BufferedSocket] = {}
        self._retry: LoopTimer | None = None
        self._announcing: LoopTimer | None = None
        self._greeting: Greeting | None = None

    def open(self, address: tuple[str, int], accepted: Mapping[str, str]) -> None:
        self._address, self._accepted = address, accepted

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        if self._address is not None and looks_for_names(type_name) and self._announcing is None:
            self._announcing = self._context.loop.after(0, lambda: self._show(names()))

    def greet(self, fields: Mapping[str, str], greeted: Callable[[bytes], None]) -> None:
        """Call `greeted` with what comes on one more connection, unless `close` is called before."""
        if self._greeting is not None:
            self._greeting.close()
        if self._address is not None:
            try:
                self._greeting = Greeting(self._context, self._host, self._address, fields, greeted)
            except (OSError, OverflowError):
                greeted(b"")

    def _show(self, names: frozenset[str]) -> None:
        self._announcing = None
        self._wanted = names
        for name in [stream for stream in self._streams if stream not in names]:
            self._streams.pop(name).close()
        self._open_missing()

    def close(self) -> None:
        self._wanted, self._address = frozenset(), None
        if self._greeting is not None:
            self._greeting.close()
            self._greeting = None
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        for timer in (self._retry, self._announcing):
            if timer is not None:
                timer.cancel()
        self._retry = self._announcing = None

    def _open_missing(self) -> None:
        self._retry = None
        if self._address is None:
            return
        for name in sorted(self._wanted - self._streams.keys()):
            try:
                sock = begin_connect(*self._address)
            except (OSError, OverflowError):
                self._try_again()
                return
            self._streams[name] = BufferedSocket(
                self._context.loop,
                sock,
                partial(self._on_data, name),
                partial(self._on_break, name),
                payer=self._context.payer(self._host),
                opened=partial(self._connected, name),
            )

    def _connected(self, name: str) -> None:
        fields = {"callerid": name, "topic": self._topic, **self._accepted, "tcp_nodelay": "1"}
        self._streams[name].send(encode_header(fields))

    def _on_data(self, name: str, data: bytes) -> None:
        if not data:
            self._streams[name].close()
            self._on_break(name, "")

    def _on_break(self, name: str, _reason: str) -> None:
        self._streams.pop(name, None)
        self._try_again()

    def _try_again(self) -> None:
        if self._retry is None:
            self._retry = self._context.loop.after(_RETRY_SECONDS, self._open_missing)


class Greeting:
    """A connection to a publisher until its first messages, or for two seconds; then `ended(frames)` is called once.

    The memory of the publisher's host counts the frames. Without memory, or after a failure, they are empty. Raises
    `OSError` or `OverflowError` for an address that cannot be used.
    """

    def __init__(
        self,
        context: RelayContext,
        host: str,
        address: tuple[str, int],
        fields: Mapping[str, str],
        ended: Callable[[bytes], None],
    ) -> None:
        self._context = context
        sock = begin_connect(*address)
        self._parser: HeaderParser | None = HeaderParser(context.limits.header_bytes)
        self._held = HeldBytes(context.memory.frames.of(host))
        self._data, self._seen = bytearray(), 0
        self._ended = ended
        self._timer = context.loop.after(context.limits.connect_seconds, self._fail)
        self._stream = BufferedSocket(
            context.loop,
            sock,
            self._on_data,
            lambda _reason: self._fail(),
            payer=context.payer(host),
            opened=lambda: self._stream.send(encode_header(fields)),
        )

    def close(self) -> None:
        self._timer.cancel()
        self._stream.close()
        self._held.set(0)

    def _on_data(self, data: bytes) -> None:
        if not data:
            self._fail()
            return
        if self._parser is not None:
            try:
                header = self._parser.feed(data)
            except PeerError:
                self._fail()
                return
            if header is None:
                return
            data, self._parser = self._parser.rest, None
            self._wait(_GREETING_SECONDS)
        if data and not self._data:
            self._wait(_SILENT_SECONDS)
        if self._held.share.refusal(len(data)) or len(self._data) > self._context.limits.message_bytes:
            self._fail()
            return
        self._data += data
        self._held.set(len(self._data))

    def _wait(self, seconds: float) -> None:
        self._timer.cancel()
        self._timer = self._context.loop.after(seconds, self._look)

    def _look(self) -> None:
        whole, messages, _ = walk(memoryview(self._data), _GREETING_MESSAGES)
        if messages < _GREETING_MESSAGES and whole < len(self._data) != self._seen:
            self._seen = len(self._data)
            self._wait(_SILENT_SECONDS)
        else:
            self._end(bytes(self._data[:whole]))

    def _fail(self) -> None:
        self._end(b"")

    def _end(self, frames: bytes) -> None:
        self.close()
        self._ended(frames)
