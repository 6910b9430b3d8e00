"""The relay's one connection to a publisher for one topic: ask control for the address, connect, receive.

    idle --want--> asked --UpstreamFound--> connecting --connected--> greeting --header--> flowing
      ^               |                          |                        |                  |
      +---linger------+------ refused, failed, lost: wait (doubling), then ask again --------+

A publisher that turns the relay's header away is asked again at once with another header, while there is one
(`introductions`).

A `PublisherConnection` tries again while the topic is wanted. The wait doubles after each failure, including a
publisher that sends its header and then closes the connection or breaks the protocol. A connection that flowed for more
than `retry_longest` seconds resets the wait.
"""

import os
import socket
from collections.abc import Callable, Iterable, Mapping

from appliance.channel.messages import PublicationRefused, UpstreamLost, UpstreamWanted
from appliance.channel.messages.relay_link import Violation
from appliance.relay.connections.headers import size_of
from appliance.relay.connections.introductions import Introductions
from appliance.relay.connections.named_subscribers import NamedSubscribers, looks_for_names
from appliance.relay.connections.relayed_topic import RelayedTopic, Upstream
from appliance.relay.context import RelayContext
from appliance.relay.loop import READ, LoopTimer
from appliance.relay.transport.frames import SMALL, Batch, FrameReceiver
from appliance.relay.transport.memory import HeldBytes, StallDetector
from appliance.relay.transport.pump import JUDGED, RECEIVED, UNARMED, Left
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.errors import LimitExceededError, PeerError
from roswire.tcpros import HeaderParser, encode_header

_CALLER_ID = "/rosrv"
_REASON = 1000  # most characters of a reported error; a publisher chooses the text in its header


class PublisherConnection(Upstream):
    """The upstream of one relayed topic; `objection(header)` returns why a publisher is refused (empty: accepted).

    `unsettled()`: a reload or a restart is under way, after which subscribers return.
    """

    def __init__(
        self,
        context: RelayContext,
        topic: RelayedTopic,
        *,
        claims: Callable[[], Iterable[Mapping[str, str]]],
        registered_type: Callable[[], str],
        unsettled: Callable[[], bool],
        objection: Callable[[dict[str, str]], str] = lambda _header: "",
    ) -> None:
        self._loop = context.loop
        self._clock = context.loop.clock
        self._topic = topic
        self._payer_of = context.payer
        self._payer = context.payer(topic.host)
        self._reporter = context.reporter
        self._limits = limits = context.limits
        self._weight = HeldBytes(context.memory.frames.of(topic.host))
        self._receiver = FrameReceiver(
            context.scratch, limits.message_bytes, context.memory.frames.of(topic.host)
        )
        self._stall = StallDetector(limits.stall_seconds)
        self._pumped = context.loop.pump.connection()
        self._buffer = self._receiver.buffer
        self._received = self._receiver.received
        self._wanted = False
        self._asked = False
        self.failures = 0
        self._flowing = 0.0  # since when
        self._timer: LoopTimer | None = None
        self._linger: LoopTimer | None = None
        self._pause: LoopTimer | None = None
        self._announcing: LoopTimer | None = None
        self._rest: Batch | None = None
        self._left = False  # whether received data is left for the next turn
        self._scheduled = False
        self._since = 0.0
        self._early = b""
        self._scratch = context.scratch
        self._rest_weight = HeldBytes(context.memory.frames.of(topic.host))
        self._stream: BufferedSocket | None = None
        self._socket: socket.socket | None = None
        self._recv_into: Callable[[memoryview], int]
        self._parser = HeaderParser(limits.header_bytes)
        self._address = ("", 0)
        self._header: dict[str, str] = {}
        self._named_subscribers = NamedSubscribers(context, topic.topic, topic.host)
        self._introductions = Introductions(claims, registered_type)
        self._unsettled = unsettled
        self._introduced = False  # whether this connection was sent the header
        self._objection = objection
        self._objected = ""

    def connect(self) -> None:
        """Connect, unless a connection exists or is under way."""
        self._wanted = True
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None
        if self._socket is None and self._stream is None and self._timer is None:
            self.ask()

    def release(self) -> None:
        """Close the connection after this turn of the loop, because a lazy publisher has to learn that it is unused.

        Keep it for a short time while subscribers may return.
        """
        self._wanted = False
        if self._linger is None:
            seconds = self._limits.linger if self._unsettled() else 0.0
            self._linger = self._loop.after(seconds, self._close_unwanted)

    def ask(self) -> None:
        """Ask control for the publisher's address; repeat the question if no answer comes."""
        self._asked = True
        self._set_timer(self._limits.answer_seconds, self.ask)
        self._reporter.send(UpstreamWanted(self._topic.key, self._topic.topic))

    def ask_again(self) -> None:
        """Repeat an open question to a new control."""
        if self._asked:
            self.ask()

    def found(self, host: str, port: int) -> None:
        """Connect to the address that control has found; ignore an answer that is no longer awaited."""
        if not self._asked:
            return
        self._asked = False
        self._address = (host, port)
        self._payer = self._payer_of(self._topic.host)
        try:
            sock = begin_connect(host, port)
        except (OSError, OverflowError) as error:
            self._lose(f"cannot connect to {host}:{port}: {error}")
            return
        self._parser = HeaderParser(self._limits.header_bytes)
        self._introduced = False
        self._stream = BufferedSocket(
            self._loop,
            sock,
            self._header_received,
            self._broken,
            payer=self._payer,
            opened=self._connected,
        )
        self._set_timer(self._limits.connect_seconds, self._late(f"no answer from {host}:{port}"))

    def refused(self) -> None:
        """Ask again later, because control has no address."""
        if self._asked:
            self._asked = False
            self._retry()

    def close(self) -> None:
        """Close everything, because the publication is withdrawn."""
        self._wanted = False
        self._asked = False
        for timer in (self._timer, self._linger, self._pause):
            if timer is not None:
                timer.cancel()
        self._timer = self._linger = self._pause = None
        self._drop_connection()

    def pause(self, seconds: float) -> None:
        """Stop reading the publisher until `resume`, for at most `seconds`; its data stays in the kernel's buffer."""
        if self._socket is not None and self._pause is None:
            self._loop.unwatch(self._socket.fileno())
            self._pause = self._loop.after(seconds, self._topic.relieve)

    def resume(self) -> None:
        """Go on reading."""
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
            if self._left:
                self._go_on_later()
            elif self._socket is not None:
                self._loop.watch(self._socket.fileno(), READ, self._ready, self._payer, self._pumped)

    def check_stall(self) -> None:
        """Cut a publisher that holds memory for a message and sends nothing of it; called once a second."""
        self._receiver.trim_buffer()
        held = self._receiver.unfinished if self._pause is None and not self._left else 0
        if self._stall.seen(held, self._clock()):
            self._lose(
                f"{held} bytes of a message arrived, then no data for {self._limits.stall_seconds:g} s",
                "limit exceeded",
            )

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        """Show the names of new subscribers to a publisher whose type needs them."""
        if self._socket is not None and looks_for_names(type_name) and self._announcing is None:
            self._announcing = self._loop.after(0, lambda: self._show(names()))

    def _show(self, names: frozenset[str]) -> None:
        self._announcing = None
        self._named_subscribers.update(names, self._address, self._introductions.fields)

    def _connected(self) -> None:
        fields = {
            "callerid": _CALLER_ID,
            "topic": self._topic.topic,
            **self._introductions.fields,
            "tcp_nodelay": "1",
        }
        if self._stream is not None:
            self._introduced = True
            self._stream.send(encode_header(fields))

    def _header_received(self, data: bytes) -> None:
        if self._stream is None:
            return
        if not data:
            self._turned_away("the publisher closed the connection before its header")
            return
        try:
            header = self._parser.feed(data)
        except PeerError as error:
            self._lose(f"the publisher's header cannot be read: {error}", _violation(error))
            return
        if header is None:
            return
        size = size_of(header)
        refusal = _refusal(header) or self._no_room(size)
        if refusal is not None:
            end = self._turned_away if "error" in header else self._lose
            end(*refusal)
            return
        reason = self._objection(header)
        if reason:
            self._object(reason)
            return
        self._weight.set(size)
        self._header = header
        self._flow(header, self._stream.take(), self._parser.rest)

    def _no_room(self, size: int) -> tuple[str, Violation] | None:
        if size > SMALL and self._weight.share.refusal(size):
            return "the relay has no memory left for headers of this host", "limit exceeded"
        return None

    def request_latched(self) -> None:
        """Reconnect, so that a latching publisher sends its message again."""
        if self._socket is not None and self._wanted:
            self._drop_connection()
            self.ask()

    def recheck(self) -> None:
        """Disconnect a publisher that the specifications now reject, or try a rejected one again.

        A quiet publisher keeps no earlier module of the monitors in memory.
        """
        self._disarm()
        if self._socket is not None:
            reason = self._objection(self._header)
            if reason:
                self._object(reason)
        elif self._objected and self._timer is not None and not self._asked and self._stream is None:
            self.failures = 0
            self.ask()

    def _object(self, reason: str) -> None:
        """Disconnect and retry: the publisher may return with another message definition."""
        if reason != self._objected:
            self._objected = reason
            self._reporter.send(PublicationRefused(self._topic.key, self._topic.topic, reason))
        self._drop_connection()
        self._retry()

    def _flow(self, header: dict[str, str], sock: socket.socket, rest: bytes) -> None:
        self._stream = None
        self._socket = sock
        self._objected = ""
        self._introductions.accepted()
        self._flowing = self._clock()
        self._set_timer(0, None)
        self._loop.watch(sock.fileno(), READ, self._ready, self._payer, self._pumped)
        self._recv_into = sock.recv_into
        self._topic.upstream_opened(header)
        self._early = rest
        self._take_early()

    def _ready(self, _events: int) -> None:
        left = self._pumped.step()
        if left is None:
            return
        self._disarm()
        if left.kind == UNARMED:
            try:
                count = self._recv_into(self._buffer())
            except BlockingIOError:
                return
            except OSError as error:
                self._received_count(-(error.errno or 0))
            else:
                self._received_count(count)
        elif left.kind == RECEIVED:
            self._received_count(left.end)
        else:
            self._go_on_behind(left)
        self._arm()

    def _received_count(self, count: int) -> None:
        """Take received bytes; 0 is the end of the connection, a negative number the number of an error."""
        if count > 0:
            self._take(count)
        elif count:
            self._lose(f"the connection to the publisher broke: {os.strerror(-count)}")
        else:
            self._lose("the publisher closed the connection")

    def _go_on_behind(self, left: Left) -> None:
        """Process whole frames further than the pump has done."""
        batch = self._receiver.found(left.size, left.end, left.messages)
        batch.judged, batch.answer = left.judged, left.answer
        if left.kind == JUDGED:
            rest = self._topic.received(batch, left.since)
        else:
            rest = None
            self._topic.sent(batch, left.since, left.number, left.sent)
        self._since = left.since
        self._continue(rest)

    def _disarm(self) -> None:
        """Take the next frames from the pump, with the incomplete one."""
        torn = self._pumped.disarm()
        if torn:
            self._receiver.resume(torn)

    def _arm(self) -> None:
        """Leave the next frames to the pump if they need only the common work."""
        if self._socket is None or self._left or self._early or not self._receiver.small:
            return
        simple = self._topic.simple()
        if simple is not None:
            torn = self._receiver.hand_over()
            self._pumped.arm(self._socket.fileno(), self._topic, *simple, torn=torn)

    def _take(self, count: int) -> None:
        since = self._clock()
        try:
            batch = self._received(count)
        except PeerError as error:
            self._lose(str(error), _violation(error))
            return
        if batch is not None:
            rest = self._topic.received(batch, since)
            if rest is not None or self._receiver.more or self._topic.undelivered:
                self._since = since
                self._continue(rest)

    def _continue(self, rest: Batch | None) -> None:
        """Process received data until the quantum is used up; read from the publisher only when all is processed."""
        sock = self._socket
        while sock is not None and self._socket is sock:
            receiver = self._receiver
            over = receiver.more and (self._pause is not None or self._loop.over())
            if rest is not None or over or self._topic.undelivered:
                self._leave(rest)
                return
            if not receiver.more:
                self._read_on()
                return
            try:
                batch = receiver.following()
            except PeerError as error:
                self._lose(str(error), _violation(error))
                return
            rest = None if batch is None else self._topic.received(batch, self._since)

    def _leave(self, rest: Batch | None) -> None:
        """Keep these frames, and all other received data, for the publisher's next turn."""
        self._rest = rest
        self._rest_weight.set(self._topic.undelivered + (0 if rest is None else len(rest.view)))
        self._receiver.set_aside()
        if not self._left and self._socket is not None:
            self._left = True
            self._loop.unwatch(self._socket.fileno())
        self._go_on_later()

    def _go_on_later(self) -> None:
        if self._pause is None and not self._scheduled:
            self._scheduled = True
            self._loop.later(self._go_on, self._payer)

    def _go_on(self) -> None:
        self._scheduled = False
        if not self._left or self._pause is not None:
            return
        self._topic.hand_out()
        if self._topic.undelivered or self._pause is not None:
            self._leave(self._rest)
            return
        rest, self._rest = self._rest, None
        self._rest_weight.set(0)
        if rest is not None:
            rest = self._topic.go_on(self._scratch.hold(rest), self._since)
        self._continue(rest)

    def _read_on(self) -> None:
        if self._left and self._socket is not None:
            self._left = False
            if self._pause is None:
                self._loop.watch(self._socket.fileno(), READ, self._ready, self._payer, self._pumped)
            self._take_early()

    def _take_early(self) -> None:
        while self._early and self._socket is not None and not self._left:
            buffer = self._buffer()
            count = min(len(self._early), len(buffer))
            buffer[:count] = self._early[:count]
            self._early = self._early[count:]
            self._take(count)

    def _broken(self, reason: str) -> None:
        lose = self._turned_away if self._introduced else self._lose
        lose(f"no connection to the publisher: {reason}")

    def _turned_away(self, reason: str, violation: Violation = "") -> None:
        """Ask again with another header; lose the publisher if it has turned all of them away."""
        if self._introductions.refused():
            self._drop_connection()
            self.ask()
        else:
            self._lose(reason, violation)

    def _late(self, reason: str) -> Callable[[], None]:
        return lambda: self._lose(f"{reason} within {self._limits.connect_seconds:g} s")

    def _lose(self, reason: str, violation: Violation = "") -> None:
        self._drop_connection()
        self._reporter.send(UpstreamLost(self._topic.key, self._topic.topic, reason[:_REASON], violation))
        self._retry()

    def _retry(self) -> None:
        self._set_timer(0, None)
        if self._wanted:
            wait = min(self._limits.retry_first * 2.0**self.failures, self._limits.retry_longest)
            self.failures = min(self.failures + 1, 32)
            self._set_timer(wait, self.ask)

    def _close_unwanted(self) -> None:
        self._linger = None
        self._set_timer(0, None)
        self._asked = False
        self._drop_connection()

    def _drop_connection(self) -> None:
        self._named_subscribers.close()
        if self._announcing is not None:
            self._announcing.cancel()
            self._announcing = None
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        if self._socket is not None:
            if self._clock() - self._flowing > self._limits.retry_longest:
                self.failures = 0
            self._loop.discard(self._socket)
            self._socket = None
            self._rest, self._left, self._early = None, False, b""
            self._rest_weight.set(0)
            self._weight.set(0)
            self._pumped.disarm()
            self._receiver.abandon()
            self._topic.upstream_closed()

    def _set_timer(self, seconds: float, callback: Callable[[], None] | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if callback is None else self._loop.after(seconds, callback)


def _refusal(header: dict[str, str]) -> tuple[str, Violation] | None:
    """Return why a publisher's header is rejected, and the kind of violation."""
    if "error" in header:
        return f"the publisher says: {header['error']}", "connection refused"
    missing = [field for field in ("type", "md5sum") if field not in header]
    if missing:
        return f"the publisher's header lacks the field {missing[0]}", "malformed"
    return None


def _violation(error: PeerError) -> Violation:
    return "limit exceeded" if isinstance(error, LimitExceededError) else "malformed"
