import struct

import pytest

from appliance.relay.connections.service_client import ServiceExchange
from roswire.errors import LimitExceededError, ProtocolError
from roswire.tcpros import ServiceReply, encode_frame, encode_service_error, encode_service_reply


class Conversation:
    def __init__(self, *, persistent: bool = False, limit: int = 1 << 20) -> None:
        self.service: list[bytes] = []
        self.client: list[bytes] = []
        self.counted: list[int] = []
        self.exchange = ServiceExchange(
            limit,
            persistent=persistent,
            to_service=self.service.append,
            to_client=self.client.append,
            count=self.counted.append,
            judge=lambda _part, body: ServiceReply(True, body),
            asks=lambda _body: False,
        )

    def ask(self, data: bytes) -> None:
        self.exchange.from_client(data)
        self.exchange.advance()


def test_a_call_is_one_request_and_one_reply() -> None:
    call = Conversation()
    call.ask(encode_frame(b"ask"))
    assert (call.service, call.exchange.done) == ([encode_frame(b"ask")], False)
    call.exchange.from_service(encode_service_reply(b"answer"))
    assert (call.client, call.exchange.done) == ([encode_service_reply(b"answer")], True)
    assert call.counted == [7, 11]
    assert call.exchange.held == 0


def test_a_persistent_connection_goes_on() -> None:
    call = Conversation(persistent=True)
    for text in (b"1", b"2", b"3"):
        call.ask(encode_frame(text))
        call.exchange.from_service(encode_service_reply(text))
    assert call.service == [encode_frame(text) for text in (b"1", b"2", b"3")]
    assert not call.exchange.done


def test_a_service_error_is_passed_on_with_its_text() -> None:
    call = Conversation()
    call.ask(encode_frame(b""))
    call.exchange.from_service(encode_service_error("no such bolt"))
    assert call.client == [encode_service_error("no such bolt")]


def test_bytes_may_come_one_by_one() -> None:
    call = Conversation()
    for byte in encode_frame(b"ask"):
        assert call.service == []
        call.ask(bytes([byte]))
    for byte in encode_service_reply(b"answer"):
        assert call.client == []
        call.exchange.from_service(bytes([byte]))
    assert (call.service, call.client) == ([encode_frame(b"ask")], [encode_service_reply(b"answer")])


def test_a_second_request_waits_for_the_first_reply() -> None:
    call = Conversation(persistent=True)
    readable = [call.exchange.may_read]
    call.ask(encode_frame(b"1") + encode_frame(b"2"))
    assert call.service == [encode_frame(b"1")]
    readable.append(call.exchange.may_read)
    call.exchange.from_service(encode_service_reply(b""))
    readable.append(call.exchange.may_read)
    call.exchange.advance()
    assert readable == [True, False, False]
    assert call.service == [encode_frame(b"1"), encode_frame(b"2")]


def test_a_reply_without_a_request_is_the_services_fault() -> None:
    call = Conversation(persistent=True)
    with pytest.raises(ProtocolError, match="without a request"):
        call.exchange.from_service(encode_service_reply(b""))


@pytest.mark.parametrize("length", [(1 << 20) + 1, 0xFFFFFFFF])
def test_lengths_beyond_the_limit_are_refused(length: int) -> None:
    call = Conversation()
    with pytest.raises(LimitExceededError):
        call.exchange.from_client(struct.pack("<I", length))
    call = Conversation()
    call.ask(encode_frame(b""))
    with pytest.raises(LimitExceededError):
        call.exchange.from_service(struct.pack("<BI", 1, length))


def test_an_ok_byte_that_is_neither_is_refused() -> None:
    call = Conversation()
    call.ask(encode_frame(b""))
    with pytest.raises(ProtocolError):
        call.exchange.from_service(b"\x02\0\0\0\0")
