"""The relay's one connection to a publisher for one topic: ask control for the address, connect, receive.

    idle --want--> asked --UpstreamFound--> connecting --connected--> greeting --header--> flowing
      ^               |                          |                        |                  |
      +---linger------+------ refused, failed, lost: wait (doubling), then ask again --------+

A publisher that turns the relay's header away is asked again at once with another header (`header_candidates.py`). The
wait starts over once a connection has flowed for more than `retry_longest` seconds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from appliance.channel.messages import PublicationRefused, UpstreamLost, UpstreamWanted
from appliance.channel.messages.relay_link import Violation
from appliance.relay.connections.header_candidates import HeaderCandidates
from appliance.relay.connections.headers import size_of
from appliance.relay.connections.named_subscribers import NamedSubscribers
from appliance.relay.connections.relayed_topic import RelayedTopic, Upstream
from appliance.relay.connections.upstream_reader import UpstreamReader, violation_of
from appliance.relay.context import RelayContext
from appliance.relay.loop import LoopTimer
from appliance.relay.transport.frames import SMALL
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header

_CALLER_ID = "/rosrv"
_NEWCOMER_ID = "/rosrv_newcomer"  # another one: rospy drops an earlier connection of the same name
_REASON = 1000  # most characters of a reported error; a publisher chooses the text in its header


class UpstreamState(Enum):
    """The event for which a connection to a publisher waits; in WAITING, the time of the next try after a failure."""

    IDLE = auto()
    ASKED = auto()
    CONNECTING = auto()
    GREETING = auto()
    FLOWING = auto()
    WAITING = auto()


@dataclass(slots=True)
class _Attempt:
    """A connection that is not open yet."""

    stream: BufferedSocket
    parser: HeaderParser
    address: tuple[str, int]


class PublisherConnection(Upstream):
    """The upstream of one relayed topic."""

    def __init__(self, context: RelayContext, topic: RelayedTopic) -> None:
        self._context = context
        self._loop = context.loop
        self._topic = topic
        self._named_subscribers = NamedSubscribers(context, topic.topic, topic.host)
        self._headers = HeaderCandidates.of(context, topic)
        self.state = UpstreamState.IDLE
        self.failures = 0
        self._wanted = False
        self._silent = False
        self._objected = ""
        self._timer: LoopTimer | None = None  # of the state
        self._linger: LoopTimer | None = None
        self._attempt: _Attempt | None = None
        self._reader: UpstreamReader | None = None

    def connect(self) -> None:
        self._wanted = True
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None
        if self.state is UpstreamState.IDLE and not self._silent:
            self.ask()

    def silence(self, *, silent: bool) -> None:
        before, self._silent = self._silent, silent
        if silent and not before:
            self._drop_connection()
            self._enter(UpstreamState.IDLE)
        elif before and not silent and self._wanted:
            self.failures = 0
            self.ask()

    def release(self) -> None:
        """Close the connection after this turn of the loop: a lazy publisher has to learn that it is unused."""
        self._wanted = False
        if self._linger is None:
            seconds = (
                self._context.limits.linger if self._context.unsettled else 0.0
            )  # subscribers may still return
            self._linger = self._loop.after(seconds, self._close_unwanted)

    def ask(self) -> None:
        self._enter(UpstreamState.ASKED, self._context.limits.answer_seconds, self.ask)
        self._context.reporter.send(UpstreamWanted(self._topic.key, self._topic.topic))

    def ask_again(self) -> None:
        if self.state is UpstreamState.ASKED:
            self.ask()

    def found(self, host: str, port: int) -> None:
        if self.state is not UpstreamState.ASKED:
            return
        try:
            sock = begin_connect(host, port)
        except (OSError, OverflowError) as error:
            self._lose(f"cannot connect to {host}:{port}: {error}")
            return
        payer = self._context.payer(self._topic.host)
        stream = BufferedSocket(
            self._loop, sock, self._header_received, self._on_break, payer=payer, opened=self._connected
        )
        self._attempt = _Attempt(stream, HeaderParser(self._context.limits.header_bytes), (host, port))
        late = f"no answer from {host}:{port} within {self._context.limits.connect_seconds:g} s"
        self._enter(UpstreamState.CONNECTING, self._context.limits.connect_seconds, lambda: self._lose(late))

    def refused(self) -> None:
        if self.state is UpstreamState.ASKED:
            self._retry()

    def close(self) -> None:
        self._wanted = False
        if self._linger is not None:
            self._linger.cancel()
        self._close_unwanted()

    def pause(self, seconds: float) -> None:
        if self._reader is not None:
            self._reader.pause(seconds)

    def resume(self) -> None:
        if self._reader is not None:
            self._reader.resume()

    def check_stall(self) -> None:
        if self._reader is not None:
            self._reader.check_stall()

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        self._named_subscribers.announce(names, type_name)

    def request_latched(self) -> None:
        if self._reader is not None and self._wanted:
            self._drop_connection(repeats=True)
            self.ask()

    def greet(self, greeted: Callable[[bytes], None]) -> None:
        self._named_subscribers.greet({**self._fields, "callerid": _NEWCOMER_ID}, greeted)

    def recheck(self) -> None:
        """Disconnect a publisher that the specifications now reject, or retry a rejected one.

        The connection is disarmed first: that of a silent publisher would otherwise use the previous module for ever.
        """
        if self._reader is not None:
            self._reader.disarm()
            reason = self._context.interceptor.objection(self._topic.point, self._reader.header)
            if reason:
                self._object(reason)
        elif self._objected and self.state is UpstreamState.WAITING:
            self.failures = 0
            self.ask()

    def _connected(self) -> None:
        if self._attempt is not None:
            self.state = UpstreamState.GREETING
            self._attempt.stream.send(encode_header(self._fields))

    @property
    def _fields(self) -> dict[str, str]:
        return {
            "callerid": _CALLER_ID,
            "topic": self._topic.topic,
            **self._headers.fields,
            "tcp_nodelay": "1",
        }

    def _header_received(self, data: bytes) -> None:
        attempt = self._attempt
        if attempt is None:
            return
        if not data:
            self._turned_away("the publisher closed the connection before its header")
            return
        try:
            header = attempt.parser.feed(data)
        except PeerError as error:
            self._lose(f"the publisher's header cannot be read: {error}", violation_of(error))
            return
        if header is None:
            return
        refusal = self._refusal(header)
        if refusal is not None:
            end = self._turned_away if "error" in header else self._lose
            end(*refusal)
            return
        reason = self._context.interceptor.objection(self._topic.point, header)
        if reason:
            self._object(reason)
            return
        self._flow(header, attempt)

    def _refusal(self, header: Mapping[str, str]) -> tuple[str, Violation] | None:
        if "error" in header:
            return f"the publisher says: {header['error']}", "connection refused"
        missing = [field for field in ("type", "md5sum") if field not in header]
        if missing:
            return f"the publisher's header lacks the field {missing[0]}", "malformed"
        size = size_of(header)
        if size > SMALL and self._context.memory.frames.of(self._topic.host).refusal(size):
            return "the relay has no memory left for headers of this host", "limit exceeded"
        return None

    def _object(self, reason: str) -> None:
        """Disconnect and retry: the publisher may return with another message definition."""
        if reason != self._objected:
            self._objected = reason
            self._context.reporter.send(PublicationRefused(self._topic.key, self._topic.topic, reason))
        self._drop_connection()
        self._retry()

    def _flow(self, header: dict[str, str], attempt: _Attempt) -> None:
        self._attempt = None
        self._objected = ""
        self._headers.accepted()
        self._enter(UpstreamState.FLOWING)
        self._named_subscribers.open(attempt.address, self._headers.fields)
        sock = attempt.stream.take()
        self._reader = reader = UpstreamReader(self._context, self._topic, sock, header, self._lose)
        self._topic.upstream_opened(header)
        reader.start(attempt.parser.rest)

    def _on_break(self, reason: str) -> None:
        lose = self._turned_away if self.state is UpstreamState.GREETING else self._lose
        lose(f"no connection to the publisher: {reason}")

    def _turned_away(self, reason: str, violation: Violation = "") -> None:
        if self._headers.advance():
            self._drop_connection()
            self.ask()
        else:
            self._lose(reason, violation)

    def _lose(self, reason: str, violation: Violation = "") -> None:
        self._drop_connection()
        topic = self._topic
        self._context.reporter.send(UpstreamLost(topic.key, topic.topic, reason[:_REASON], violation))
        self._retry()

    def _retry(self) -> None:
        if not self._wanted:
            self._enter(UpstreamState.IDLE)
            return
        wait = min(self._context.limits.retry_first * 2.0**self.failures, self._context.limits.retry_longest)
        self.failures = min(self.failures + 1, 32)
        self._enter(UpstreamState.WAITING, wait, self.ask)

    def _close_unwanted(self) -> None:
        self._linger = None
        self._drop_connection()
        self._enter(UpstreamState.IDLE)

    def _drop_connection(self, *, repeats: bool = False) -> None:
        self._named_subscribers.close()
        if self._attempt is not None:
            self._attempt.stream.close()
            self._attempt = None
        if self._reader is not None:
            if self._loop.clock() - self._reader.since > self._context.limits.retry_longest:
                self.failures = 0
            self._reader.close()
            self._reader = None
            self._topic.upstream_closed(repeats=repeats)

    def _enter(
        self, state: UpstreamState, seconds: float = 0.0, late: Callable[[], None] | None = None
    ) -> None:
        self.state = state
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if late is None else self._loop.after(seconds, late)
