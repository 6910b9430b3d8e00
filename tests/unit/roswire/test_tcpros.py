import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roswire.errors import LimitExceededError, PeerError, ProtocolError
from roswire.tcpros import (
    FrameParser,
    HeaderParser,
    ServiceReply,
    ServiceReplyParser,
    decode_header,
    encode_frame,
    encode_header,
    encode_service_error,
    encode_service_reply,
)

FIELDS = {
    "callerid": "/listener",
    "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
    "message_definition": "string data\n\n# a = b\n",
    "tcp_nodelay": "0",
    "topic": "/chatter",
    "type": "std_msgs/String",
}
NAMES = st.from_regex(r"[a-z_0-9]{1,12}", fullmatch=True)


def length(size: int) -> bytes:
    return struct.pack("<I", size)


def header(*fields: bytes) -> bytes:
    body = b"".join(length(len(field)) + field for field in fields)
    return length(len(body)) + body


def test_the_notation_of_a_header() -> None:
    assert encode_header({"topic": "/a", "type": "*"}) == b"\x16\0\0\0\x08\0\0\0topic=/a\x06\0\0\0type=*"
    assert decode_header(b"\x08\0\0\0topic=/a\x06\0\0\0type=*") == {"topic": "/a", "type": "*"}


@given(
    fields=st.dictionaries(NAMES, st.text(st.characters(exclude_categories=["Cs"]))), cut=st.integers(1, 40)
)
def test_headers_come_back_in_any_pieces(fields: dict[str, str], cut: int) -> None:
    data = encode_header(fields) + b"behind"
    parser = HeaderParser(limit=1 << 20)
    result = None
    position = 0
    while result is None:
        result = parser.feed(data[position : position + cut])
        position += cut
    assert result == fields
    assert list(result) == list(fields)
    assert parser.rest + data[position:] == b"behind"


def test_value_may_hold_equal_signs_and_be_empty() -> None:
    assert decode_header(header(b"a=b=c", b"d=")[4:]) == {"a": "b=c", "d": ""}


def test_message_definitions_keep_their_bytes() -> None:
    """roscpp sends Latin-1 comments."""
    raw = header(b"message_definition=# 20 \xb0C\nfloat64 t", b"topic=/a")
    fields = HeaderParser().feed(raw)
    assert fields is not None
    assert encode_header(fields) == raw


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        (length(65537), LimitExceededError, "65537 bytes; at most 65536"),
        (b"GET / HTTP/1.1\r\n\r\n", LimitExceededError, "is this a TCPROS peer"),
        (length(0xFFFFFFFF), LimitExceededError, "4294967295 bytes"),
        (length(8) + length(5) + b"a=bc", ProtocolError, "says 5 bytes; 4 are left"),
        (length(8) + length(0xFFFFFFFF) + b"a=bc", ProtocolError, "says 4294967295 bytes"),
        (length(3) + b"abc", ProtocolError, "3 bytes left over at byte 0"),
        (header(b"a=b", b"a=b"), ProtocolError, "'a' occurs twice"),
        (header(b"topic"), ProtocolError, "no '='"),
        (header(b""), ProtocolError, "no '='"),
        (header(b"=b"), ProtocolError, "no valid name"),
        (header(b" a=b"), ProtocolError, "no valid name"),
        (header(b"\xc3\xa9=b"), ProtocolError, "no valid name"),
        (header(b"a\n=b"), ProtocolError, "no valid name"),
        (header(b"a=b", b"callerid=/\xff"), ProtocolError, "'callerid' is not UTF-8"),
    ],
)
def test_headers_that_are_refused(data: bytes, error: type[ProtocolError], text: str) -> None:
    with pytest.raises(error, match=text):
        HeaderParser().feed(data)


def test_a_lying_length_is_refused_before_anything_is_kept() -> None:
    parser = HeaderParser(limit=100)
    assert parser.feed(b"\x65\0\0") is None
    with pytest.raises(LimitExceededError):
        parser.feed(b"\0")


def test_an_empty_header_is_complete() -> None:
    parser = HeaderParser()
    assert parser.feed(length(0) + b"x") == {}
    assert parser.rest == b"x"


def test_a_complete_header_takes_nothing_more() -> None:
    parser = HeaderParser()
    parser.feed(encode_header(FIELDS))
    with pytest.raises(RuntimeError):
        parser.feed(b"x")


@given(data=st.binary(max_size=80))
def test_random_bytes_raise_only_the_error_for_the_peer(data: bytes) -> None:
    for parser in (HeaderParser(limit=60), FrameParser(limit=60), ServiceReplyParser(limit=60)):
        try:
            parser.feed(length(len(data)) + data)
            if not isinstance(parser, HeaderParser):
                parser.feed(data)
        except PeerError as error:
            assert str(error).isprintable()
    try:
        fields = decode_header(data)
    except PeerError:
        return
    assert decode_header(encode_header(fields)[4:]) == fields


@given(bodies=st.lists(st.binary(max_size=20), max_size=6), cut=st.integers(1, 30))
def test_frames_come_back_in_any_pieces(bodies: list[bytes], cut: int) -> None:
    data = b"".join(map(encode_frame, bodies))
    parser = FrameParser()
    received = [body for at in range(0, len(data), cut) for body in parser.feed(data[at : at + cut])]
    assert received == bodies


@given(
    replies=st.lists(st.tuples(st.booleans(), st.text("ab\u00e9", max_size=20)), max_size=6),
    cut=st.integers(1, 30),
)
def test_service_replies_come_back_in_any_pieces(replies: list[tuple[bool, str]], cut: int) -> None:
    data = b"".join(
        encode_service_reply(text.encode()) if ok else encode_service_error(text) for ok, text in replies
    )
    parser = ServiceReplyParser()
    received = [reply for at in range(0, len(data), cut) for reply in parser.feed(data[at : at + cut])]
    assert received == [ServiceReply(ok, text.encode()) for ok, text in replies]


def test_frames_beyond_the_limit_are_refused_at_their_length() -> None:
    with pytest.raises(LimitExceededError, match="11 bytes; at most 10"):
        FrameParser(limit=10).feed(length(11))
    with pytest.raises(LimitExceededError, match="11 bytes; at most 10"):
        ServiceReplyParser(limit=10).feed(b"\x01" + length(11))
    with pytest.raises(ProtocolError, match="first byte is 2"):
        ServiceReplyParser().feed(b"\x02")


def test_the_notation_of_service_replies() -> None:
    assert encode_service_reply(b"ab") == b"\x01\x02\0\0\0ab"
    assert encode_service_error("no\ud800") == b"\x00\x03\0\0\0no?"
