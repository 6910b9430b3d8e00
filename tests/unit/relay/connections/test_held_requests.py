from typing import Any

import pytest

from appliance.channel.messages import HeldRequestDecided
from appliance.relay.connections.own_service import AWAY, HeldRequests
from appliance.relay.connections.service_client import ServiceExchange
from roswire.errors import ProtocolError
from roswire.tcpros import ServiceReply, encode_frame, encode_service_error, encode_service_reply
from tests.unit.relay.monitors.quiet import Timers


class Relay:
    def __init__(self, *, asks: bool = True) -> None:
        self.asks = asks
        self.loop, self.asked = Timers(), list[Any]()
        self.service, self.client = bytearray(), bytearray()
        self.approvals = HeldRequests(self.loop, self.asked.append)
        self.exchange = ServiceExchange(
            1000,
            persistent=True,
            to_service=self.service.extend,
            to_client=self.client.extend,
            count=lambda _size: None,
            judge=lambda _part, body: ServiceReply(True, body),
            asks=self.ask,
        )
        self.approvals.attach(True)

    def question(self, host: str, body: bytes = b"") -> int:
        return self.approvals.ask(("/home", host, "/it"), "std_srvs/SetBool", body, lambda _refused: None)

    def ask(self, body: bytes) -> bool:
        if self.asks:
            self.approvals.ask(("/home", "10.0.0.7", "/it"), "std_srvs/SetBool", body, self.exchange.settle)
        return self.asks

    def request(self, *bodies: bytes) -> None:
        self.exchange.from_client(b"".join(map(encode_frame, bodies)))
        self.exchange.advance()


def test_a_held_request_reaches_the_service_only_when_approved() -> None:
    relay = Relay()
    relay.request(b"\x01", b"\x02")
    assert not relay.service and not relay.exchange.may_read
    relay.exchange.advance()
    [wanted] = relay.asked
    assert (wanted.service, wanted.host, wanted.caller_id, wanted.shown) == (
        "/home",
        "10.0.0.7",
        "/it",
        b"\x01",
    )
    relay.approvals.answered(HeldRequestDecided(wanted.number + 1, ""))
    assert not relay.service, "the answer to another request"
    relay.approvals.answered(HeldRequestDecided(wanted.number, ""))
    relay.approvals.answered(HeldRequestDecided(wanted.number, ""))
    assert relay.service == encode_frame(b"\x01")
    relay.exchange.from_service(encode_service_reply(b"done"))
    relay.exchange.advance()
    assert relay.asked[1].digest != wanted.digest
    relay.approvals.answered(HeldRequestDecided(relay.asked[1].number, "held for approval 17"))
    assert relay.service == encode_frame(b"\x01")
    assert relay.client.endswith(encode_service_error("held for approval 17"))


def test_a_reply_without_a_request_is_an_error_while_one_is_held() -> None:
    relay = Relay()
    relay.request(b"\x01")
    with pytest.raises(ProtocolError, match="without a request"):
        relay.exchange.from_service(encode_service_reply(b"mine"))


def test_requests_are_refused_without_control() -> None:
    """So are requests that wait when control ends. Answers come in later turns, so a flood does not recurse."""
    relay = Relay()
    relay.request(b"\x01")
    relay.approvals.attach(False)
    relay.request(b"\x02")
    assert len(relay.asked) == 1 and relay.client.count(AWAY.encode()) == 1
    relay.loop.run_due()
    assert relay.client.count(AWAY.encode()) == 2 and not relay.service


def test_a_client_that_asks_no_longer_is_not_held() -> None:
    """The grant decides at each request, so a change of the policy also counts for open connections."""
    relay = Relay()
    relay.asks = False
    relay.request(b"\x01")
    assert relay.service == encode_frame(b"\x01")
    reads = [relay.exchange.may_read]
    relay.exchange.from_service(encode_service_reply(b"done"))
    reads.append(relay.exchange.may_read)
    assert (reads, relay.exchange.unfinished) == ([False, True], 0)
    relay.asks = True
    relay.request(b"\x01")
    assert relay.service == encode_frame(b"\x01") and len(relay.asked) == 1


def test_control_gets_few_questions_of_a_host_at_once() -> None:
    relay = Relay()
    numbers = [relay.question("10.0.0.66") for _ in range(1000)]
    other = relay.question("10.0.0.7")
    assert [one.number for one in relay.asked] == [*numbers[:2], other]
    for number in numbers[1:-1]:  # one of them is with control
        relay.approvals.forget(number)
    for number in (other, *numbers[:2]):
        relay.approvals.answered(HeldRequestDecided(number, ""))
    assert [one.number for one in relay.asked[3:]] == [numbers[-1]]
    relay.approvals.attach(False)
    relay.approvals.attach(True)
    fresh = [relay.question("10.0.0.66") for _ in range(3)]
    relay.approvals.answered(HeldRequestDecided(numbers[-1], ""))
    assert [one.number for one in relay.asked[4:]] == fresh[:2]
