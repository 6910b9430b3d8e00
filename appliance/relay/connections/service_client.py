"""The connection from a service client, and the matching connection to the service.

A service that never answers delays only this client. If the service cannot be reached, or dies before its header, the
client gets an error header, as rospy and roscpp expect; later, its connection ends, as in plain ROS.
"""

import errno
import socket
from collections import deque
from collections.abc import Callable, Mapping

from appliance.channel.messages import PublicationRefused, TopicTraffic
from appliance.relay.connections.headers import size_of, switched_on, to_client, to_service
from appliance.relay.connections.monitor_calls import ServiceCalls
from appliance.relay.connections.own_service import OwnServer
from appliance.relay.context import RelayContext
from appliance.relay.grant_table import PeerGrant, ServiceEndpoint
from appliance.relay.loop import LoopTimer
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.transport.frames import SMALL
from appliance.relay.transport.memory import HeldBytes, StallDetector
from appliance.relay.transport.pump import Traffic
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.errors import PeerError, ProtocolError
from roswire.tcpros import (
    FrameParser,
    HeaderParser,
    ServiceReply,
    ServiceReplyParser,
    encode_frame,
    encode_header,
    encode_service_error,
    encode_service_reply,
)

# The requests and replies of one service connection after the headers, without sockets.
#
# - The service has at most one request at a time. A reply without a request is an error.
# - While a client has an open request or does not read its replies, the relay reads nothing from it.
# - A request that needs an approval is held; only `settle` passes it to monitors and the service.

_REPLY_HEAD = 5  # bytes before the body of a reply


class ServiceExchange:
    """The requests and replies of one connection.

    `held` counts the bytes of incomplete and waiting requests, `held_replies` those of incomplete replies.
    """

    def __init__(
        self,
        limit: int,
        *,
        persistent: bool,
        to_service: Callable[[bytes], None],
        to_client: Callable[[bytes], None],
        count: Callable[[int], None],
        judge: Callable[[str, bytes], ServiceReply],
        asks: Callable[[bytes], bool],
    ) -> None:
        self._persistent = persistent
        self._to_service = to_service
        self._to_client = to_client
        self._count = count
        self._judge = judge
        self._asks = asks
        self._requests = FrameParser(limit)
        self._replies = ServiceReplyParser(limit)
        self._waiting: deque[bytes] = deque()
        self._asking = False  # whether the first waiting request needs an approval
        self._busy = False
        self.done = False
        self.held = 0
        self.held_replies = 0

    @property
    def may_read(self) -> bool:
        return not self._busy and not self._waiting and not self.done

    @property
    def ready(self) -> bool:
        return bool(self._waiting) and not self._busy and not self._asking and not self.done

    @property
    def unfinished(self) -> int:
        return self.held_replies + (0 if self._waiting else self.held)

    def from_client(self, data: bytes) -> None:
        self.held += len(data)
        self._waiting.extend(self._requests.feed(data))

    def from_service(self, data: bytes) -> None:
        self.held_replies += len(data)
        for reply in self._replies.feed(data):
            if not self._busy:
                raise ProtocolError("the service sent a reply without a request")
            self.held_replies -= len(reply.body) + _REPLY_HEAD
            self._busy = False
            self._answer(self._judge("response", reply.body) if reply.ok else reply)

    def advance(self) -> None:
        if self.ready:
            self._asking = self._asks(self._waiting[0])
            if not self._asking:
                self.settle("")

    def settle(self, refused: str) -> None:
        """Pass the first waiting request on, or refuse it for this reason."""
        self._asking = False
        body = self._waiting.popleft()
        data = encode_frame(body)
        self.held -= len(data)
        self._count(len(data))
        judged = ServiceReply(False, refused.encode()) if refused else self._judge("request", body)
        if judged.ok:
            self._busy = True
            self._to_service(data if judged.body is body else encode_frame(judged.body))
        else:
            self._answer(judged)

    def _answer(self, reply: ServiceReply) -> None:
        text = "" if reply.ok else reply.body.decode("utf-8", "replace")
        data = encode_service_reply(reply.body) if reply.ok else encode_service_error(text)
        self.done = not self._persistent
        self._count(len(data))
        self._to_client(data)


_PATIENT = 1 << 20  # bytes that may wait without a time limit, while the host has memory


class ServiceTraffic:
    """The traffic of one service since the last report, and its clients."""

    def __init__(self) -> None:
        self._counters = Traffic()
        self._clients = 0
        self._changed = False

    def count(self, size: int) -> None:
        self._counters.add(1, size)
        self._changed = True

    def connected(self, change: int) -> None:
        self._clients += change
        self._changed = True

    def row(self, key: str, service: str) -> TopicTraffic | None:
        if not self._changed:
            return None
        self._changed = False
        return TopicTraffic(key, service, *self._counters.take()[:2], 0, self._clients)


class ServiceClient:
    """One client of one service; `caller_id` is its verified name.

    Exactly one of two callbacks is called, once: `ended(self)` after both connections are closed, or `refuse(self,
    sock, reason)`, which takes over the client's socket.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        service: ServiceEndpoint,
        host: str,
        fields: Mapping[str, str],
        *,
        caller_id: str,
        traffic: ServiceTraffic,
        calls: ServiceCalls,
        refuse: Callable[["ServiceClient", socket.socket, str], None],
        ended: Callable[["ServiceClient"], None],
    ) -> None:
        self.service = service
        self.host = host
        self.caller_id = caller_id
        self._context = context
        self.fields = fields
        self._traffic = traffic
        self._refuse = refuse
        self._ended = ended
        self._calls = calls
        self._question = 0  # the last one to control
        self._number = 0
        self._live = True
        memory = context.memory
        self._weights = (
            HeldBytes(memory.frames.of(host)),
            HeldBytes(memory.frames.of(service.host)),
            HeldBytes(memory.queues.of(host)),
        )
        self._stall = StallDetector(context.limits.stall_seconds)
        self._server: BufferedSocket | OwnServer | None = None
        self._timer: LoopTimer | None = None
        self._parser = HeaderParser(context.limits.header_bytes)
        self._greeted = False
        self._header: dict[str, str] = {}
        self._client = BufferedSocket(
            context.loop,
            sock,
            self._client_received,
            self.cut,
            payer=context.payer(host),
            drained=self._advance,
        )
        self._client.read(False)
        self._exchange = ServiceExchange(
            context.limits.message_bytes,
            persistent=switched_on(fields, "persistent"),
            to_service=self._to_service,
            to_client=self._client.send,
            count=traffic.count,
            judge=self._judge,
            asks=self._ask,
        )

    @property
    def grant(self) -> PeerGrant:
        return "service", self.service.key, self.service.service, self.host, self.caller_id

    def start(self, rest: bytes) -> None:
        try:
            self._exchange.from_client(rest)
            self._server = self._reach()
        except (OSError, OverflowError) as error:
            self._turn_away(f"cannot connect to the service: {_why(error)}")
            return
        except PeerError as error:
            self._turn_away(str(error))
            return
        self._patience(self._context.limits.connect_seconds)
        self._weigh()

    def _reach(self) -> BufferedSocket | OwnServer:
        loop, service = self._context.loop, self.service
        if service.own:
            called = service.service, self.host, self.caller_id
            received, opened = self._server_received, self._connected
            return OwnServer(self._calls.own, loop, called=called, received=received, opened=opened)
        sock = begin_connect(service.host, service.port)
        received, broken = self._server_received, self._server_broken
        return BufferedSocket(
            loop, sock, received, broken, payer=self._context.payer(self.host), opened=self._connected
        )

    def recheck(self) -> None:
        if self._greeted:
            objection = self._context.interceptor.service_objection(self._server_point, self._header)
            if objection:
                self.cut(objection)

    def tidy(self) -> None:
        held = self._exchange.unfinished + self._unsent
        patience = SMALL if any(weight.share.exhausted for weight in self._weights) else _PATIENT
        if self._stall.has_stalled(held if held > patience else 0, self._context.loop.clock()):
            seconds = self._context.limits.stall_seconds
            self.cut(f"{held} bytes of a message wait, without progress for {seconds:g} s")

    def cut(self, reason: str) -> None:
        if self._live:
            self._release()
            self._client.close()
            self._context.reporter.closed(self._number, reason)
            self._ended(self)

    def _patience(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._context.loop.after(
            seconds, lambda: self._turn_away(f"the service does not answer within {seconds:g} s")
        )

    def _connected(self) -> None:
        self._patience(self._context.limits.service_seconds)
        self._to_service(encode_header(to_service(self.fields, self.caller_id)))

    def _server_received(self, data: bytes) -> None:
        if not data:
            self._server_ended("the service closed the connection")
        elif self._greeted:
            self._safely(self._exchange.from_service, data)
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
        objection = self._context.interceptor.service_objection(self._server_point, header)
        if objection:
            self._context.reporter.send(PublicationRefused(self.service.key, self.service.service, objection))
            self._turn_away(objection)
            return
        self._greeted = True
        self._header = header
        if self._timer is not None:
            self._timer.cancel()
        self._number = self._context.reporter.opened(
            self.service.key, self.service.service, "service", self.host, self.caller_id
        )
        self._traffic.connected(1)
        self._client.send(encode_header(to_client(header, self.service.node)))
        self._safely(self._exchange.from_service, self._parser.rest)

    def _judge(self, part: str, body: bytes) -> ServiceReply:
        point = self._server_point
        if part == "request":
            point = point._replace(host=self.host, caller_id=self.caller_id)
        return self._context.interceptor.judge(point, part, body)

    @property
    def _server_point(self) -> ObservationPoint:
        return ObservationPoint(self.service.key, self.service.service, self.service.host, self.service.node)

    def _ask(self, body: bytes) -> bool:
        if not self._context.table.asks(*self.grant[1:]):
            return False
        caller = self.service.service, self.host, self.caller_id
        self._question = self._calls.held_requests.ask(
            caller, self._header.get("type", ""), body, self._on_decision
        )
        return True

    def _on_decision(self, refused: str) -> None:
        if self._live:
            self._exchange.settle(refused)
            self._advance()

    def _client_received(self, data: bytes) -> None:
        if not data:
            self.cut("")
        else:
            self._safely(self._exchange.from_client, data)

    def _safely(self, feed: Callable[[bytes], None], data: bytes) -> None:
        try:
            feed(data)
        except PeerError as error:
            self.cut(str(error))
            return
        self._advance()

    def _advance(self) -> None:
        if not self._live or not self._greeted:
            return
        while self._live and not self._client.backlog:
            if self._exchange.done or self._server is None:
                self.cut("")
                return
            if not self._exchange.ready:
                break
            self._exchange.advance()
        if self._live:
            self._client.read(self._exchange.may_read and not self._client.backlog)
            self._weigh()

    def _weigh(self) -> None:
        """Cut the connection if a part has no memory left.

        A whole message may wait even if it exceeds the quota, as for a subscriber: the host's next one has no memory.
        """
        *incomplete, waiting = self._weights
        full = self._unsent > max(SMALL, waiting.size) and waiting.share.exhausted
        waiting.set(self._unsent)
        of_service = self._exchange.held_replies + size_of(self._header)
        for weight, size in zip(incomplete, (self._exchange.held, of_service), strict=True):
            weight.set(size)
            full = full or (size > SMALL and weight.share.exhausted)
        if full:
            self.cut("the relay has no memory left for messages of this host")

    @property
    def _unsent(self) -> int:
        return self._client.backlog + (self._server.backlog if self._server else 0)

    def _to_service(self, data: bytes) -> None:
        if self._server is not None:
            self._server.send(data)

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
            self.cut("" if self._exchange.may_read or self._exchange.done else reason)

    def _turn_away(self, reason: str) -> None:
        if self._live:
            self._release()
            self._refuse(self, self._client.take(), reason)

    def _release(self) -> None:
        self._live = False
        self._calls.held_requests.forget(self._question)
        if self._timer is not None:
            self._timer.cancel()
        if self._server is not None:
            self._server.close()
        for weight in self._weights:
            weight.set(0)
        if self._greeted:
            self._traffic.connected(-1)


def _why(error: Exception) -> str:
    """Return the error's name, without the address of the service's node, which the client must not learn."""
    return errno.errorcode.get(
        (error.errno if isinstance(error, OSError) else None) or 0, "it has no usable address"
    )
