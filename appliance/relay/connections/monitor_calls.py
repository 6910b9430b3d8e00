"""The service calls of monitors, which the appliance's own node makes.

The relay connects to the service's port as any client does, so all checks apply, and request and response are events
of the service. A failed call is reported once, as a fault of its monitor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from appliance.channel.messages import (
    HeldRequestDecided,
    MonitorCallAnswered,
    MonitorCallWanted,
    OwnServiceAnswered,
)
from appliance.relay.connections.own_service import HeldRequests, OwnService
from appliance.relay.context import RelayContext
from appliance.relay.loop import LoopTimer
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, ServiceReplyParser, encode_frame, encode_header

if TYPE_CHECKING:
    from rosmop.run.outcomes import Published

OwnAnswer = OwnServiceAnswered | MonitorCallAnswered | HeldRequestDecided
MAX, MAX_OF_MONITOR = 64, 4
"""The most calls under way in a relay, and of one monitor, so that no monitor takes the calls of the others."""


@dataclass(eq=False, slots=True)
class _Call:
    """A call under way; `sock` is its connection, once control has granted it."""

    wanted: Published
    timer: LoopTimer
    header: HeaderParser = field(default_factory=HeaderParser)
    replies: ServiceReplyParser = field(default_factory=ServiceReplyParser)
    greeted: bool = False
    sock: BufferedSocket | None = None


class ServiceCalls:
    """The calls under way, with control's answers about the appliance's own services and approvals."""

    def __init__(self, context: RelayContext) -> None:
        self.own = OwnService(context.loop, context.reporter.send)
        self.held_requests = HeldRequests(context.loop, context.reporter.send)
        self._context = context
        self._calls: dict[int, _Call] = {}
        self._number = 0
        self._connected = False

    def call(self, wanted: Published) -> None:
        own = sum(call.wanted.monitor == wanted.monitor for call in self._calls.values())
        for number, most, whose in (
            (own, MAX_OF_MONITOR, wanted.monitor),
            (len(self._calls), MAX, "all monitors"),
        ):
            if number >= most:
                self._failed(wanted, f"{most} calls of {whose} are under way; the call was not made")
                return
        self._number += 1
        number, loop = self._number, self._context.loop
        seconds = self._context.limits.service_seconds
        late = f"no response within {seconds:g} s"
        self._calls[number] = _Call(wanted, loop.after(seconds, lambda: self._end(number, late)))
        if self._connected:
            self._context.reporter.send(MonitorCallWanted(number, wanted.topic))
        else:
            loop.after(0, lambda: self._end(number, "the appliance's control is not running"))

    def answered(self, message: OwnAnswer) -> None:
        if isinstance(message, OwnServiceAnswered):
            self.own.answered(message)
            return
        if isinstance(message, HeldRequestDecided):
            self.held_requests.answered(message)
            return
        call, number = self._calls.get(message.number), message.number
        if call is None:
            return
        monitors = self._context.interceptor.monitors
        if message.refused or monitors is None:
            self._end(number, message.refused or "there are no monitors any longer")
            return
        try:
            sock = begin_connect(message.host, message.port)
        except (OSError, OverflowError) as error:
            self._end(number, str(error))
            return
        header = {
            "callerid": message.caller_id,
            "service": call.wanted.topic,
            "type": call.wanted.type,
            "md5sum": monitors.definitions.service_md5sum(call.wanted.type),
        }
        call.sock = BufferedSocket(
            self._context.loop,
            sock,
            lambda data: self._on_data(number, data),
            lambda reason: self._end(number, reason),
            payer=message.host,
            opened=lambda: self._on_open(number, encode_header(header)),
        )

    def attach(self, connected: bool) -> None:
        self._connected = connected
        self.own.control_gone()
        self.held_requests.attach(connected)
        for number, call in list(self._calls.items()):
            if call.sock is None:
                self._end(number, "the appliance's control has ended")

    def _on_open(self, number: int, header: bytes) -> None:
        call = self._calls.get(number)
        if call is not None and call.sock is not None:
            call.sock.send(header + encode_frame(call.wanted.data))

    def _on_data(self, number: int, data: bytes) -> None:
        call = self._calls.get(number)
        if call is None:
            return
        if not data:
            self._end(number, "the connection was closed without a response")
            return
        try:
            if not call.greeted:
                header = call.header.feed(data)
                if header is None:
                    return
                if "error" in header:
                    self._end(number, header["error"])
                    return
                call.greeted, data = True, call.header.rest
            replies = call.replies.feed(data)
        except PeerError as error:
            self._end(number, str(error))
            return
        if replies:
            self._end(number, "" if replies[0].ok else replies[0].body.decode("utf-8", "replace"))

    def _end(self, number: int, reason: str) -> None:
        call = self._calls.pop(number, None)
        if call is None:
            return
        call.timer.cancel()
        if call.sock is not None:
            call.sock.close()
        if reason:
            self._failed(call.wanted, reason)

    def _failed(self, wanted: Published, reason: str) -> None:
        interceptor = self._context.interceptor
        for monitor in interceptor.monitors.monitors if interceptor.monitors is not None else ():
            monitor.faults += monitor.name == wanted.monitor
        text = f"the call of {wanted.topic} failed: {reason}"
        interceptor.observer.call_failed(wanted.monitor, wanted.topic, interceptor.now(), text)
