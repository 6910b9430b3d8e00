"""A service client's connection and the one made for it to the service.

The client's header has been checked against the grants; the service is connected to, gets the client's header
written afresh (`persistent`, `probe`, `md5sum=*` and a session's own fields included), and its answer goes
back the same way. Then requests and replies alternate (`exchange`).

A service that never answers holds this client and nobody else. One that cannot be reached, or dies before its
header, is answered with an error header, as rospy and roscpp expect; one that dies later ends the client's
connection, as it would without the appliance.
"""

import socket
from collections.abc import Callable, Mapping

from appliance.channel.messages import PublicationRefused, TopicTraffic
from appliance.relay.context import RelayContext
from appliance.relay.exchange import ServiceExchange
from appliance.relay.grants import Service
from appliance.relay.loop import Timer
from appliance.relay.memory import Stall
from appliance.relay.middle import Judged
from appliance.relay.sockets import Stream, begin_connect
from appliance.ros.errors import PeerError
from appliance.ros.tcpros import HeaderParser, encode_header

_TRUE = frozenset({"1", "true", "True"})
_ALWAYS_HELD = 1 << 20


class ServiceTraffic:
    """What went through one service since the last report, and how many are connected."""

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0
        self.clients = 0
        self.changed = False

    def count(self, size: int) -> None:
        """A request or reply of so many bytes goes through."""
        self.messages += 1
        self.bytes += size
        self.changed = True

    def connected(self, change: int) -> None:
        """So many clients more are connected."""
        self.clients += change
        self.changed = True

    def row(self, key: str, service: str) -> TopicTraffic | None:
        """The counters since the last call; None when nothing has changed."""
        if not self.changed:
            return None
        row = TopicTraffic(key, service, self.messages, self.bytes, 0, self.clients)
        self.messages = self.bytes = 0
        self.changed = False
        return row


class ServiceClient:
    """One client of one service.

    Either `ended()` is called once, when both connections are closed, or `refuse(sock, reason)`, which takes
    the client's socket over.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        service: Service,
        host: str,
        fields: Mapping[str, str],
        *,
        traffic: ServiceTraffic,
        refuse: Callable[[socket.socket, str], None],
        ended: Callable[[], None],
    ) -> None:
        self.service = service
        self.host = host
        self._context = context
        self._fields = fields
        self._traffic = traffic
        self._refuse = refuse
        self._ended = ended
        self._number = 0
        self._live = True
        self._weight = 0
        self._share = context.shares.of(host)
        self._stall = Stall(context.limits.stall_seconds)
        self._server: Stream | None = None
        self._timer: Timer | None = None
        self._parser = HeaderParser(context.limits.header_bytes)
        self._greeted = False
        self._header: dict[str, str] = {}
        self._exchange = ServiceExchange(
            context.limits.message_bytes,
            persistent=fields.get("persistent", "") in _TRUE,
            to_service=self._to_service,
            to_client=self._to_client,
            count=traffic.count,
            judge=self._judge,
        )
        self._client = Stream(
            context.loop, sock, self._client_received, self._client_broken, drained=self._advance
        )
        self._client.read(False)

    def start(self, rest: bytes) -> None:
        """Connect to the service; `rest` is what the client has sent after its header."""
        where = f"{self.service.host}:{self.service.port}"
        try:
            self._exchange.from_client(rest)
            sock = begin_connect(self.service.host, self.service.port)
        except (OSError, OverflowError) as error:
            self._turn_away(f"cannot connect to the service at {where}: {error}")
            return
        except PeerError as error:
            self._turn_away(str(error))
            return
        self._server = Stream(
            self._context.loop, sock, self._server_received, self._server_broken, opened=self._connected
        )
        seconds = self._context.limits.connect_seconds
        self._timer = self._context.loop.after(
            seconds, lambda: self._turn_away(f"the service at {where} does not answer within {seconds:g} s")
        )

    def judge_again(self) -> None:
        """Other specifications are in force: a service that does not fit them is carried no longer."""
        if self._greeted:
            objection = self._context.middle.service_objection(self.service.service, self._header)
            if objection:
                self._close(objection)

    def look(self) -> None:
        """A second is over: one that keeps memory for a message that nothing comes of, or is not taken, is cut."""
        held = (
            self._exchange.unfinished + self._client.backlog + (self._server.backlog if self._server else 0)
        )
        if self._stall.seen(held if held > _ALWAYS_HELD else 0, self._context.loop.clock()):
            seconds = self._context.limits.stall_seconds
            self._close(
                f"{held} bytes of a message wait, and nothing of it has come or gone for {seconds:g} s"
            )

    def cut(self, reason: str) -> None:
        """Close both connections: what they stand on is gone."""
        self._close(reason)

    def _connected(self) -> None:
        self._to_service(encode_header(self._fields))

    def _server_received(self, data: bytes) -> None:
        if not data:
            self._server_ended("the service closed the connection")
        elif self._greeted:
            self._guard(self._exchange.from_service, data)
        else:
            self._header_received(data)

    def _header_received(self, data: bytes) -> None:
        try:
            header = self._parser.feed(data)
        except PeerError as error:
            self._turn_away(f"the service's header cannot be read: {error}")
            return
        if header is None:
            return
        if "error" in header:
            self._turn_away(header["error"])
            return
        objection = self._context.middle.service_objection(self.service.service, header)
        if objection:
            self._context.reporter.send(PublicationRefused(self.service.key, self.service.service, objection))
            self._turn_away(objection)
            return
        self._greeted = True
        self._header = header
        if self._timer is not None:
            self._timer.cancel()
        self._number = self._context.reporter.opened(
            self.service.key, self.service.service, "service", self.host, self._fields["callerid"]
        )
        self._traffic.connected(1)
        self._to_client(encode_header(header))
        self._guard(self._exchange.from_service, self._parser.rest)

    def _judge(self, part: str, body: bytes) -> Judged:
        """What the monitors make of a request or a reply. They may be others than when the client came."""
        middle, service = self._context.middle, self.service
        return (
            middle.request(service.key, service.service, body)
            if part == "request"
            else middle.response(service.key, service.service, body)
        )

    def _client_received(self, data: bytes) -> None:
        if not data:
            self._close("")
        else:
            self._guard(self._exchange.from_client, data)

    def _guard(self, feed: Callable[[bytes], None], data: bytes) -> None:
        """Feed the exchange; whoever breaks the protocol loses the connection."""
        try:
            feed(data)
        except PeerError as error:
            self._close(str(error))
            return
        self._advance()

    def _advance(self) -> None:
        """Go on as far as the client has taken what was written to it."""
        if not self._live or not self._greeted:
            return
        while self._live and not self._client.backlog:
            if self._exchange.done or self._server is None:
                self._close("")
                return
            if not self._exchange.ready:
                break
            self._exchange.advance()
        if self._live:
            self._client.read(self._exchange.may_read and not self._client.backlog)
            self._weigh()

    def _weigh(self) -> None:
        """Count what this connection holds in memory; too much for the process ends it."""
        weight = self._exchange.held + self._client.backlog + (self._server.backlog if self._server else 0)
        self._share.used += weight - self._weight
        self._weight = weight
        if weight > _ALWAYS_HELD and self._share.exhausted:
            self._close("the relay has no memory left for this message")

    def _to_service(self, data: bytes) -> None:
        if self._server is not None:
            self._server.send(data)

    def _to_client(self, data: bytes) -> None:
        self._client.send(data)

    def _client_broken(self, reason: str) -> None:
        self._close(reason)

    def _server_broken(self, reason: str) -> None:
        if self._greeted:
            self._server_ended(f"the connection to the service broke: {reason}")
        else:
            self._turn_away(f"no connection to the service: {reason}")

    def _server_ended(self, reason: str) -> None:
        if not self._greeted:
            self._turn_away(reason)
            return
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._client.backlog:
            self._client.read(False)
        else:
            self._close("" if self._exchange.may_read or self._exchange.done else reason)

    def _turn_away(self, reason: str) -> None:
        """The client gets the reason in a header of its own."""
        if self._live:
            self._release()
            self._refuse(self._client.take(), reason)

    def _close(self, reason: str) -> None:
        if self._live:
            self._release()
            self._client.close()
            self._context.reporter.closed(self._number, reason)
            self._ended()

    def _release(self) -> None:
        self._live = False
        if self._timer is not None:
            self._timer.cancel()
        if self._server is not None:
            self._server.close()
        self._share.used -= self._weight
        if self._greeted:
            self._traffic.connected(-1)
