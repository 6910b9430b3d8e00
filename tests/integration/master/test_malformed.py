"""Malformed HTTP and XML, sent to RVMaster or a node's endpoint, is rejected and recorded, and affects no other."""

import re
import zlib

import pytest

from tests.integration.master.test_attacks import POLICY as POLICY  # noqa: PLC0414 - the field's policy
from tests.support.field import Field
from tests.support.processes import LIMIT

HEAD = "POST /RPC2 HTTP/1.1\r\nHost: m\r\n"
CALL = "<methodCall><methodName>{}</methodName><params>{}</params></methodCall>"
TEXT = "<param><value><string>{}</string></value></param>"


def post(body: bytes | str, *headers: str) -> bytes:
    """Return a request with this body."""
    data = body.encode() if isinstance(body, str) else body
    return "\r\n".join([HEAD.strip(), *headers, f"Content-Length: {len(data)}", "", ""]).encode() + data


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: m\r\n\r\n", 405),
        (b"DELETE / HTTP/1.1\r\nHost: m\r\n\r\n", 405),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\0" * 500, 400),
        (b"\x04\x00\x00\x00\x00\x00\x00\x00", 400),
        (HEAD.encode() + b"Content-Length: 99999999999\r\n\r\n", 413),
        (HEAD.encode() + b"Content-Length: -1\r\n\r\n", 400),
        (HEAD.encode() + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 400),
        (HEAD.encode() + b"Transfer-Encoding: chunked\r\n\r\n-1\r\n", 400),
        (HEAD.encode() + b"Transfer-Encoding: gzip\r\nContent-Length: 3\r\n\r\nabc", 400),
        (HEAD.encode() + b"Upgrade: websocket\r\nConnection: Upgrade\r\nContent-Length: 0\r\n\r\n", 501),
        (HEAD.encode() + b"X: " + b"y" * 70_000 + b"\r\n\r\n", 431),
        (HEAD.encode() + b"X: y\r\n" * 20_000 + b"\r\n", 431),
        (b"POST /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", 431),
        (b"POST / HTTP/1.1\r\nHost: m\r\n X: folded\r\nContent-Length: 0\r\n\r\n", None),
        (b"POST / HTTP/1.1\nHost: m\nContent-Length: 0\n\n", None),
    ],
    ids=lambda value: repr(value[:36]) if isinstance(value, bytes) else "",
)
def test_not_http(field: Field, data: bytes, status: int | None) -> None:
    """A request that is not a POST within the limits gets its status (or a fault), and never more than one answer."""
    answer = field.raw(data)
    assert answer.startswith(b"HTTP/1.1 ")
    assert answer.count(b"HTTP/1.1 ") == 1
    if status is not None:
        assert answer.split()[1] == str(status).encode()
        field.recorded(event="limit exceeded" if status in (413, 431) else "malformed", host="10.77.0.66")


DOCUMENTS = {
    "empty": b"",
    "text": b"hello",
    "binary": bytes(range(256)) * 10,
    "truncated": b"<methodCall><methodName>getPid</methodName><params>",
    "entities": b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">'
    b"]><methodCall><methodName>&b;</methodName></methodCall>",
    "external": b'<?xml version="1.0"?><!DOCTYPE l SYSTEM "file:///etc/passwd"><methodCall/>',
    "instruction": b"<?php echo 1 ?><methodCall><methodName>getPid</methodName></methodCall>",
    "utf-16": "<methodCall><methodName>getPid</methodName></methodCall>".encode("utf-16"),
    "utf-7": b'<?xml version="1.0" encoding="utf-7"?><methodCall><methodName>getPid</methodName></methodCall>',
    "nul": CALL.format("getPid", TEXT.format("/a\0b")).encode(),
    "control": CALL.format("getPid", TEXT.format("/a\x01b")).encode(),
    "bad utf-8": CALL.format("getPid", TEXT.format("/a")).encode().replace(b"/a", b"/a\xff\xfe"),
    "surrogate": CALL.format("getPid", TEXT.format("/a")).encode().replace(b"/a", b"/a\xed\xa0\x80"),
    "response": b"<methodResponse><params><param><value>x</value></param></params></methodResponse>",
    "two roots": (CALL.format("getPid", TEXT.format("/a")) * 2).encode(),
    "no name": b"<methodCall><params></params></methodCall>",
    "attribute": b'<methodCall><methodName x="y">getPid</methodName></methodCall>',
    "deep": (b"<methodCall><methodName>x</methodName><params><param>" + b"<value><array><data>" * 5000),
    "deep tags": b"<methodCall>" + b"<a>" * 100_000,
    "int64": CALL.format("setParam", "<param><value><i8>1</i8></value></param>").encode(),
    "integer": CALL.format("setParam", "<param><value><int>99999999999999999999</int></value></param>").encode(),
    "double": CALL.format("setParam", "<param><value><double>0x1p3</double></value></param>").encode(),
    "boolean": CALL.format("setParam", "<param><value><boolean>yes</boolean></value></param>").encode(),
    "base64": CALL.format("setParam", "<param><value><base64>!!!!</base64></value></param>").encode(),
    "date": CALL.format("setParam", "<param><value><dateTime.iso8601>99999999T99:99:99</dateTime.iso8601></value>"
                        "</param>").encode(),
    "twice the member": CALL.format("setParam", "<param><value><struct><member><name>a</name><value>1</value></member>"
                                    "<member><name>a</name><value>2</value></member></struct></value></param>").encode(),
    "gzip": zlib.compress(b"<methodCall/>"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOCUMENTS)
def test_not_xml_rpc(field: Field, name: str) -> None:
    """A document that is not a call is a fault for its sender, with the position of the error."""
    answer = field.raw(post(DOCUMENTS[name]))
    assert answer.startswith(b"HTTP/1.1 200")
    assert b"<fault>" in answer
    assert b"byte " in answer or b"nested deeper" in answer or b"<i8>" in answer
    assert b"passwd" not in answer


def test_faults_are_recorded(field: Field) -> None:
    """Malformed requests are recorded with their host."""
    field.raw(post(b"<methodCall><methodName>getPid</methodName><params><oops/></params></methodCall>"))
    field.recorded("byte", event="malformed", host="10.77.0.66", decision="deny")


@pytest.mark.parametrize("method", ["setParam", "getPid"])
def test_the_limit_of_values_in_one_request(field: Field, method: str) -> None:
    """A million values in one request are parsed outside the event loop; larger requests are rejected.

    Other callers do not notice.
    """
    values = "<value/>" * 1_000_010
    body = CALL.format(method, f"<param><value><array><data>{values}</data></array></value></param>")
    assert b"more than 1000000 values" in field.raw(post(body))


def test_a_multicall_of_cheap_calls(field: Field) -> None:
    """Tens of thousands of calls in one request do not delay a node, and are all answered."""
    part = "<value><struct><member><name>methodName</name><value>getPid</value></member><member><name>params</name>" \
        "<value><array><data><value>/m</value></data></array></value></member></struct></value>"  # fmt: skip
    count = 60_000
    body = CALL.format(
        "system.multicall", f"<param><value><array><data>{part * count}</data></array></value></param>"
    )
    with field.connect() as sock:
        sock.settimeout(4 * LIMIT)  # this answer has no time limit, but no other answer may wait for it
        sock.sendall(post(body))
        field.unharmed(50)
        for number in range(20):
            assert field.call(field.robot, "getPid", f"/looker{number}")[0] == 1
        received = b""
        while b"</methodResponse>" not in received[-200:]:
            piece = sock.recv(1 << 20)
            assert piece
            received += piece
    assert re.findall(rb"[^>]*parts are not carried out", received)[:1] == []
    assert received.count(b"<i4>1</i4>") + received.count(b"<int>1</int>") >= count


def test_a_call_in_one_byte_pieces(field: Field) -> None:
    """A request that arrives byte by byte is answered."""
    with field.connect() as sock:
        for byte in post(CALL.format("getPid", TEXT.format("/slow"))):
            sock.send(bytes([byte]))
        assert sock.recv(65536).startswith(b"HTTP/1.1 200")


def test_pipelined_calls(field: Field) -> None:
    """Calls sent without waiting are answered in order."""
    data = b"".join(
        post(CALL.format("hasParam", TEXT.format("/piper") + TEXT.format(f"/p{number}")))
        for number in range(50)
    )
    with field.connect() as sock:
        sock.sendall(data)
        received = b""
        while received.count(b"</methodResponse>") < 50:
            received += sock.recv(65536)
    assert [received.find(f"/p{number}<".encode()) >= 0 for number in range(50)] == [True] * 50
    places = [received.find(f"/p{number}<".encode()) for number in range(50)]
    assert places == sorted(places)


def test_malformed_on_a_nodes_face(field: Field) -> None:
    """A node's endpoint is as strict as RVMaster's port."""
    uri = field.rogue("lookupNode", "/looker", "/voice")[2]
    port = int(uri.rsplit(":", 1)[1].rstrip("/"))
    assert field.raw(b"GET / HTTP/1.1\r\n\r\n", port=port).split()[1] == b"405"
    assert b"<fault>" in field.raw(post(b"<methodCall>"), port=port)
    assert b"<fault>" in field.raw(post(DOCUMENTS["entities"]), port=port)
