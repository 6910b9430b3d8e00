"""The services that the appliance itself offers (`std_srvs/Trigger`); control answers them through the relay.

Control gets at most one call of a service from a host at a time, and one a second, so no host keeps control busy.
Further calls of that host get the same answer if it `repeats`. Other answers, such as the name of a group's holder,
may be outdated, so these calls wait for the end of the second.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from appliance.channel.messages import (
    HeldRequestDecided,
    Message,
    OwnServiceAnswered,
    OwnServiceCalled,
    RequestHeld,
)
from appliance.relay.loop import EventLoop
from roswire.tcpros import HeaderParser, encode_header, encode_service_reply

# Hold the requests of service clients that need an operator's approval until control has decided.
#
# - A request reaches the monitors and the service only after its approval.
# - Control gets at most `MAX_OF_HOST` requests of a host at once, because one thread answers all hosts.
# - If control ends first, all open requests are refused.

AWAY = "the appliance's control is not running: this call had no effect"
MAX_OF_HOST = 2
_SHOWN = 4096

Answered = Callable[[str], None]
"""Called with the reason for a refusal, or with an empty string if the request is approved."""


class HeldRequests:
    """The requests that wait for control, at most one for each client."""

    def __init__(self, loop: EventLoop, send: Callable[[Message], None]) -> None:
        self._loop = loop
        self._send = send
        self._connected = False
        self._open: dict[int, tuple[str, Answered]] = {}  # by number: the host, and who waits
        self._queues: dict[str, dict[int, RequestHeld]] = {}  # by host; control has the first ones
        self._number = 0

    def ask(self, caller: tuple[str, str, str], type_: str, body: bytes, answered: Answered) -> int:
        """Return the request's number. `caller` is the service, with the host and name of its client.

        `answered` is called once, in a later turn of the loop, unless the request is forgotten.
        """
        self._number += 1
        number, host, digest = self._number, caller[1], hashlib.sha256(body).hexdigest()
        self._open[number] = host, answered
        if self._connected:
            queue = self._queues.setdefault(host, {})
            queue[number] = RequestHeld(number, *caller, type_, digest, body[:_SHOWN], len(body))
            if len(queue) <= MAX_OF_HOST:
                self._send(queue[number])
        else:
            self._loop.after(0, lambda: self.answered(HeldRequestDecided(number, AWAY)))
        return number

    def forget(self, number: int) -> None:
        host, _answered = self._open.pop(number, ("", None))
        queue = self._queues.get(host, {})
        if number in islice(queue, MAX_OF_HOST):  # its answer will come
            self._open[number] = host, lambda _refused: None
        else:
            queue.pop(number, None)

    def answered(self, answer: HeldRequestDecided) -> None:
        host, waiting = self._open.pop(answer.number, ("", None))
        if waiting is None:
            return
        queue = self._queues.get(host, {})
        if queue.pop(answer.number, None) is not None:
            for wanted in islice(queue.values(), MAX_OF_HOST - 1, MAX_OF_HOST):
                self._send(wanted)
            if not queue:
                del self._queues[host]
        waiting(answer.refused)

    def attach(self, connected: bool) -> None:
        self._connected = connected
        self._queues.clear()
        for number in list(self._open):
            self.answered(HeldRequestDecided(number, AWAY))


HEADER: Final = {
    "type": "std_srvs/Trigger",
    "md5sum": "937c9679a518e3a18d831e57125ea522",
    "request_type": "std_srvs/TriggerRequest",
    "response_type": "std_srvs/TriggerResponse",
}
_SECOND = 1.0


@dataclass(slots=True)
class _Call:
    """A host's last call of a service; `until` is the end of its second, or 0 before the answer."""

    asked: OwnServiceCalled
    waiting: list["OwnServer"] = field(default_factory=list)
    reply: bytes = b""
    until: float = 0.0


class OwnService:
    """The calls of the appliance's own services; `send` passes a message to control if it is running."""

    def __init__(self, loop: EventLoop, send: Callable[[Message], None]) -> None:
        self._loop = loop
        self._send = send
        self._calls: dict[tuple[str, str], _Call] = {}  # by service and host
        self._number = 0

    def call(self, service: str, host: str, caller_id: str, server: "OwnServer") -> None:
        last = self._calls.get((service, host))
        if last is None or 0 < last.until <= self._loop.clock():
            self._ask(service, host, caller_id, [*([] if last is None else last.waiting), server])
        elif last.reply:
            server.answered(last.reply)
        else:
            last.waiting.append(server)

    def _ask(self, service: str, host: str, caller_id: str, waiting: list["OwnServer"]) -> None:
        self._number += 1
        asked = OwnServiceCalled(self._number, service, host, caller_id)
        self._calls[service, host] = _Call(asked, waiting)
        self._send(asked)

    def forget(self, service: str, host: str, server: "OwnServer") -> None:
        last = self._calls.get((service, host))
        if last is not None and server in last.waiting:
            last.waiting.remove(server)

    def answered(self, answer: OwnServiceAnswered) -> None:
        for call in [call for call in self._calls.values() if call.asked.number == answer.number]:
            self._settle(call, answer.success, answer.text, repeats=answer.repeats)

    def control_gone(self) -> None:
        for call in list(self._calls.values()):
            if not call.until:
                self._settle(call, False, AWAY)

    def tidy(self) -> None:
        now = self._loop.clock()
        self._calls = {
            key: call
            for key, call in self._calls.items()
            if call.waiting or not call.until or now < call.until
        }

    def _settle(self, call: _Call, success: bool, text: str, *, repeats: bool = True) -> None:
        data = text.encode()
        reply = encode_service_reply(bytes([success]) + len(data).to_bytes(4, "little") + data)
        call.until = self._loop.clock() + _SECOND
        waiting, call.waiting = call.waiting, []
        for server in waiting:
            server.answered(reply)
        if repeats:
            call.reply = reply
        else:
            self._loop.after(_SECOND, lambda: self._ask_again(call))

    def _ask_again(self, call: _Call) -> None:
        asked = call.asked
        if call.waiting and self._calls.get((asked.service, asked.host)) is call:
            self._ask(asked.service, asked.host, asked.caller_id, call.waiting)


class OwnServer:
    """One client's connection, with the methods of a `BufferedSocket`.

    It replaces the connection to a node, so grants, headers, monitors and limits apply as for any other service.
    """

    backlog = 0

    def __init__(
        self,
        own: OwnService,
        loop: EventLoop,
        *,
        called: tuple[str, str, str],
        received: Callable[[bytes], None],
        opened: Callable[[], None],
    ) -> None:
        """`called` is the service, the client's host and the client's name."""
        self._own = own
        self._loop = loop
        self._called = called
        self._received = received
        self._greeted = False
        self._timer = loop.after(0, opened)

    def send(self, data: bytes) -> None:
        if self._greeted:
            self._own.call(*self._called, self)
            return
        self._greeted = True
        fields = HeaderParser().feed(data) or {}
        md5sum = fields.get("md5sum", "")
        if md5sum in {"*", HEADER["md5sum"]}:
            self.answered(encode_header(HEADER))
        else:
            reason = f"{self._called[0]} is a {HEADER['type']} with md5sum {HEADER['md5sum']}, not {md5sum}"
            self.answered(encode_header({"error": reason}))

    def answered(self, reply: bytes) -> None:
        self._timer = self._loop.after(0, lambda: self._received(reply))

    def close(self) -> None:
        self._timer.cancel()
        self._own.forget(self._called[0], self._called[1], self)
