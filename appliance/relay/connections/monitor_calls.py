"""The service calls of monitors, which the appliance's own node makes.

A call passes through the relay like that of any client: control decides it by the policy and grants it, and a
`ServiceClient` carries it, whose client is this file. So its request and its response are events of the service.

Invariants:
- At most `MOST` calls are under way, and each ends after `seconds` at the latest.
- Each call that does not get a successful response is reported once, as a fault of its monitor.
"""

import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from appliance.channel.messages import Message, MonitorCallAnswered, MonitorCallWanted
from appliance.relay.connections.service_client import ServiceClient
from appliance.relay.loop import EventLoop, LoopTimer
from appliance.relay.monitors.observation_points import WantedCall
from appliance.relay.transport.sockets import BufferedSocket
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, ServiceReplyParser, encode_frame

MOST = 16
"""The maximum number of calls under way in a relay."""


class CallGrant(NamedTuple):
    """A grant for calls: the incarnation that offers the service, and the host and name of the appliance's node."""

    key: str
    host: str
    caller_id: str


@dataclass(eq=False, slots=True)
class _Call:
    """A call under way. `client` and `end` exist while the service is connected."""

    wanted: WantedCall
    timer: LoopTimer
    header: HeaderParser
    replies: ServiceReplyParser
    greeted: bool = False
    client: ServiceClient | None = None
    end: BufferedSocket | None = None


class ServiceCalls:
    """The calls under way.

    `send` passes a message to a running control. `valid(service, grant)` tells whether an earlier grant is in force.
    `serve(wanted, grant, sock, refused)` serves the client at the socket, and returns None if the service is gone;
    `refused(reason)` is called if the service rejects the client. `failed(wanted, reason)` reports a failed call.
    """

    def __init__(
        self,
        loop: EventLoop,
        *,
        seconds: float,
        send: Callable[[Message], None],
        valid: Callable[[str, CallGrant], bool],
        serve: Callable[
            [WantedCall, CallGrant, socket.socket, bytes, Callable[[str], None]], ServiceClient | None
        ],
        failed: Callable[[WantedCall, str], None],
    ) -> None:
        self._loop = loop
        self._seconds = seconds
        self._send = send
        self._valid = valid
        self._serve = serve
        self._failed = failed
        self._calls: dict[int, _Call] = {}
        self._grants: dict[str, CallGrant] = {}
        self._number = 0
        self.connected = False
        """Whether control is running."""

    def call(self, wanted: WantedCall) -> None:
        """Begin a call; nothing of it happens before the next turn of the loop."""
        if len(self._calls) >= MOST:
            self._failed(wanted, f"{MOST} calls of monitors are under way; the call was not made")
            return
        self._number += 1
        number = self._number
        late = f"no response within {self._seconds:g} s"
        timer = self._loop.after(self._seconds, lambda: self._end(number, late))
        self._calls[number] = _Call(wanted, timer, HeaderParser(), ServiceReplyParser())
        grant = self._grants.get(wanted.service)
        if grant is not None and self._valid(wanted.service, grant):
            self._loop.after(0, lambda: self._begin(number, grant))
        elif self.connected:
            self._send(MonitorCallWanted(number, wanted.service))
        else:
            self._loop.after(0, lambda: self._end(number, "the appliance's control is not running"))

    def answered(self, message: MonitorCallAnswered) -> None:
        """Make the call that control has granted, or report that it was denied."""
        call = self._calls.get(message.number)
        if call is None:
            return
        if message.refused:
            self._end(message.number, message.refused)
            return
        grant = CallGrant(message.key, message.host, message.caller_id)
        self._grants[call.wanted.service] = grant
        self._begin(message.number, grant)

    def attach(self, connected: bool) -> None:
        """End the calls that wait for a control that has gone."""
        self.connected = connected
        for number, call in list(self._calls.items()):
            if call.end is None:
                self._end(number, "the appliance's control has ended")

    def _begin(self, number: int, grant: CallGrant) -> None:
        call = self._calls.get(number)
        if call is None:
            return
        here, there = socket.socketpair()
        here.setblocking(False)
        there.setblocking(False)
        call.end = BufferedSocket(
            self._loop,
            here,
            lambda data: self._received(number, data),
            lambda reason: self._end(number, reason),
            payer=grant.host,
        )
        request = encode_frame(call.wanted.request)
        call.client = self._serve(
            call.wanted, grant, there, request, lambda reason: self._end(number, reason)
        )
        if call.client is None:
            there.close()
            self._end(number, "no node offers the service any longer")

    def _received(self, number: int, data: bytes) -> None:
        call = self._calls.get(number)
        if call is None:
            return
        if not data:
            self._end(number, "the service closed the connection")
            return
        try:
            if not call.greeted:
                header = call.header.feed(data)
                if header is None:
                    return
                call.greeted, data = True, call.header.rest
            replies = call.replies.feed(data)
        except PeerError as error:
            self._end(number, str(error))
            return
        if replies:
            self._end(number, "" if replies[0].ok else replies[0].body.decode("utf-8", "replace"))

    def _end(self, number: int, reason: str) -> None:
        """End a call; a reason means that it failed."""
        call = self._calls.pop(number, None)
        if call is None:
            return
        call.timer.cancel()
        if call.end is not None:
            call.end.close()
        if call.client is not None:
            call.client.cut("")
        if reason:
            self._failed(call.wanted, reason)
