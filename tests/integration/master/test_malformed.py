"""Malformed requests at the real port. `tests/unit/rpc/test_refused_requests.py` and
`tests/unit/roswire/test_xmlrpc.py` have the complete list.
"""

import re

import pytest

from tests.integration.master.test_attacks import POLICY as POLICY  # noqa: PLC0414 - the field's policy
from tests.support.field import Field
from tests.support.processes import LIMIT

CALL = "<methodCall><methodName>{}</methodName><params>{}</params></methodCall>"


def post(body: str) -> bytes:
    data = body.encode()
    return b"POST /RPC2 HTTP/1.1\r\nHost: m\r\nContent-Length: %d\r\n\r\n%b" % (len(data), data)


@pytest.mark.parametrize("node", ["", "/voice"])
def test_a_malformed_request_is_refused_and_recorded(field: Field, node: str) -> None:
    uri = field.rogue("lookupNode", "/looker", node)[2] if node else field.master
    port = int(uri.rstrip("/").rpartition(":")[2])
    assert field.raw(b"GET / HTTP/1.1\r\n\r\n", port=port).split()[1] == b"405"
    field.recorded("did not POST", event="malformed", host="10.77.0.66", decision="deny")
    answer = field.raw(post("<methodCall><methodName>getPid</methodName><params><oops/></params>"), port=port)
    assert b"<fault>" in answer
    field.recorded("byte", event="malformed", host="10.77.0.66", decision="deny")


@pytest.mark.parametrize("method", ["setParam", "getPid"])
def test_the_limit_of_values_in_one_request(field: Field, method: str) -> None:
    values = "<value/>" * 1_000_010
    body = CALL.format(method, f"<param><value><array><data>{values}</data></array></value></param>")
    assert b"more than 1000000 values" in field.raw(post(body))


def test_a_multicall_of_cheap_calls(field: Field) -> None:
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
