import gzip
import http.client
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.processes import LIMIT
from tests.support.rest import Rest
from tests.support.waiting import allowed

CONFIG = "api: 127.0.0.1:0\napi_tls: off\napi_limits: {requests_per_second: 100000, burst: 1000000}\n"


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    appliance = Appliance()
    config = appliance.directory / "appliance.yaml"
    config.write_text(CONFIG)
    appliance.options = ("--config", str(config))
    with appliance as running:
        yield running


@pytest.fixture
def rest(appliance: Appliance) -> Iterator[Rest]:
    rest = appliance.rest()
    pid = api_of(rest)
    before = resident(pid)
    yield rest
    assert api_of(rest) == pid
    # The allocator keeps the memory of compiling the largest text, once: about 66 MiB.
    assert resident(pid) < before + (96 << 20)


def api_of(rest: Rest) -> int:
    answer = rest.get("/v1/status")
    assert answer.status == 200
    return next(int(row["pid"]) for row in answer.json["processes"] if row["role"] == "api")


def resident(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    match = re.search(r"VmRSS:\s+(\d+) kB", text)
    assert match is not None
    return int(match[1]) << 10


def statuses(rest: Rest, data: bytes, idle: float = 2) -> list[int]:
    assert rest.url.hostname is not None
    got = bytearray()
    with socket.create_connection((rest.url.hostname, rest.url.port), LIMIT) as sock:
        try:
            sock.sendall(data)
            while piece := sock.recv(65_536):
                got += piece
                sock.settimeout(idle)
        except (TimeoutError, ConnectionError):
            pass
    return [int(one) for one in re.findall(rb"HTTP/1\.1 (\d{3}) ", bytes(got))]


@pytest.mark.parametrize(
    "path",
    [
        "/healthz/../v1/status", "/v1/../v1/status", "//v1/status", "/v1//status", "/v1/status/", "/V1/STATUS",
        "/%2e%2e/v1/status", "/v1/%73tatus", "/v1/status%00", "/v1/status;x", "/v1/status%2f",
        "/healthz%2f..%2fv1/status", "/healthz?/v1/status", "/healthz#/v1/status", "/v1/openapi.json/../status", "*", "http://127.0.0.1/v1/status",
        "/v1/audit/export?x=/healthz", "/\\v1\\status", "/v1/status\t", "/.well-known/../v1/status",
    ],
)  # fmt: skip
def test_no_spelling_of_a_path_bypasses_the_token(rest: Rest, path: str) -> None:
    request = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode()
    found = statuses(rest, request)
    assert found in ([400], [401], [421], [422], [200]), found
    if found == [200]:
        assert path.startswith("/healthz")
        assert not path.startswith("/healthz/")


HIDDEN = b"GET /v1/policy HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Content-Length: 0\r\nContent-Length: %d\r\n" % len(HIDDEN), HIDDEN),
        (b"Content-Length: %d\r\nContent-Length: 0\r\n" % len(HIDDEN), HIDDEN),
        (b"Transfer-Encoding: xchunked\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Transfer-Encoding : chunked\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Transfer-Encoding: chunked, identity\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Transfer-Encoding:\x0bchunked\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"X: y\r\n Transfer-Encoding: chunked\r\n", b"0\r\n\r\n" + HIDDEN),
        (b"Content-Length: +0\r\n", HIDDEN), (b"Content-Length: 0x0\r\n", HIDDEN), (b"Content-Length: -1\r\n", HIDDEN),
        (b"Content-Length: 99999999999999999999\r\n", HIDDEN),
        (b"Transfer-Encoding: chunked\r\n", b"fffffffffffffffff\r\n" + HIDDEN),
        (b"Transfer-Encoding: chunked\r\n", b"0;" + b"x" * 100_000 + b"\r\n\r\n" + HIDDEN),
        (b"Transfer-Encoding: chunked\r\n", b"0\r\nAuthorization: Bearer TOKEN\r\n\r\n" + HIDDEN),
    ],
)  # fmt: skip
def test_a_smuggled_request_is_not_served(rest: Rest, head: bytes, body: bytes) -> None:
    token = f"Authorization: Bearer {rest.token}\r\n".encode()
    outer = b"POST /v1/policy/explain HTTP/1.1\r\nHost: 127.0.0.1\r\n" + token + head + b"\r\n"
    data = outer + body.replace(b"TOKEN", (rest.token or "").encode())
    found = statuses(rest, data)
    assert found, "the outer request is answered"
    assert 200 not in found, found
    assert len(found) <= 2


def test_each_pipelined_request_needs_its_token(rest: Rest) -> None:
    token = f"Authorization: Bearer {rest.token}\r\n"
    parts = [
        f"GET /v1/whoami HTTP/1.1\r\nHost: 127.0.0.1\r\n{one}\r\n"
        for one in (token, "", f"{token}Connection: close\r\n")
    ]
    assert statuses(rest, "".join(parts).encode(), LIMIT) == [200, 401, 200]


def test_two_tokens_do_not_add_up(rest: Rest) -> None:
    wrong = "Authorization: Bearer rosrv_000000000000_" + "A" * 43 + "\r\n"
    right = f"Authorization: Bearer {rest.token}\r\n"
    for headers in (wrong + right, right + wrong):
        data = f"GET /v1/whoami HTTP/1.1\r\nHost: 127.0.0.1\r\n{headers}Connection: close\r\n\r\n"
        assert statuses(rest, data.encode()) in ([200], [401], [400])


def test_compressed_bodies_stay_compressed(rest: Rest) -> None:
    bomb = gzip.compress(b"\0" * (1 << 26), 9) * 16
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip", "If-Match": "*"}
    began = time.monotonic()
    answer = rest.request("POST", "/v1/monitors", bomb[: 1 << 19], headers)
    assert answer.status == 422
    assert time.monotonic() - began < allowed(10)


def test_unsupported_methods_are_refused(rest: Rest) -> None:
    for method in ("TRACE", "CONNECT", "PROPFIND", "OPTIONS", "INVENTED"):
        data = (
            f"{method} /v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Secret: echo\r\nConnection: close\r\n\r\n"
        )
        found = statuses(rest, data.encode())
        assert not {200, 101, 204} & set(found), (method, found)


def test_an_upgrade_bypasses_no_check(rest: Rest) -> None:
    for kind in ("websocket", "h2c"):
        data = (
            f"GET /v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade, HTTP2-Settings\r\nUpgrade: {kind}\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            "HTTP2-Settings: AAMAAABk\r\n\r\n"
        )
        found = statuses(rest, data.encode(), 5)
        assert not {101, 200} & set(found), (kind, found)


def test_a_client_that_does_not_read_delays_no_other(rest: Rest) -> None:
    idle = []
    try:
        for _ in range(20):
            connection = rest.connect()
            connection.request("GET", "/v1/openapi.json")
            assert isinstance(connection, http.client.HTTPConnection)
            idle.append(connection)
        began = time.monotonic()
        assert rest.get("/v1/status").status == 200
        assert time.monotonic() - began < allowed(5)
    finally:
        for connection in idle:
            connection.close()


@pytest.mark.parametrize(
    "data",
    [
        b"\x16\x03\x01\x02\x00garbage", b"GET / HTTP/1.1\r\nA: " + b"x" * 200_000, b"GET /v1/status HT",
        b"POST /v1/policy HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\nzz\r\n",
        b"GET http://evil/ HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    ],
)  # fmt: skip
def test_malformed_requests_are_not_served(rest: Rest, data: bytes) -> None:
    assert not {101, 200} & set(statuses(rest, data))
    assert rest.get("/v1/status").status == 200
