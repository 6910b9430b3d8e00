"""HTTP of RVMaster over loopback: what is served, what is refused, and that nobody can hold or grow it."""

import asyncio
import contextlib
import ipaddress
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import uvloop

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Standing
from appliance.quotas.table import (
    RVMASTER_ARRIVALS,
    RVMASTER_BYTES,
    RVMASTER_CONNECTIONS,
    RVMASTER_FAREWELLS,
    RVMASTER_REQUESTS,
)
from appliance.rpc.connection_table import Visitors
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits, plain_address
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import (
    AtOnce,
    Handler,
    HttpRequest,
    HttpServer,
    NoAnswerError,
    Peer,
    listen,
    not_at_once,
)
from roswire.xmlrpc import FaultReceived, parse_response

LIMITS = HttpLimits()
WAIT = 20.0
LARGE = 24 << 20  # more than the kernel's buffers take


def _of(host: int) -> Bounds:
    """A pool in which one host may have so much, and another as much again."""
    return Bounds(whole=2 * host, host=host, strangers=0, kept=0)


def _named(_host: object) -> Standing:
    return Standing.NAMED


@dataclass(frozen=True)
class Shares:
    """The pools of a server of a test."""

    connections: Bounds = RVMASTER_CONNECTIONS.bounds
    held: Bounds = RVMASTER_BYTES.bounds
    farewells: Bounds = RVMASTER_FAREWELLS.bounds
    requests: Bounds = RVMASTER_REQUESTS.bounds
    arriving: Bounds = RVMASTER_ARRIVALS.bounds
    clock: Callable[[], float] = time.thread_time


def post(body: bytes, *headers: str, path: str = "/", length: int | None = None) -> bytes:
    """A request as a ROS client sends it."""
    lines = [
        f"POST {path} HTTP/1.1",
        "Host: master",
        f"Content-Length: {len(body) if length is None else length}",
    ]
    return "\r\n".join([*lines, *headers, "", ""]).encode() + body


def fault(body: bytes) -> str:
    """The words of a fault."""
    with pytest.raises(FaultReceived) as received:
        parse_response(body)
    return received.value.text


class Client:
    """One connection, read with limits."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def send(self, data: bytes) -> None:
        """Send."""
        self.writer.write(data)
        await self.writer.drain()

    async def response(self) -> tuple[int, dict[str, str], bytes]:
        """Status, headers, body of the next response."""
        async with asyncio.timeout(WAIT):
            head = (await self.reader.readuntil(b"\r\n\r\n")).decode()
            status, *lines = head.strip().split("\r\n")
            headers = {line.split(": ")[0].lower(): line.split(": ")[1] for line in lines}
            body = await self.reader.readexactly(int(headers.get("content-length", "0")))
        return int(status.split()[1]), headers, body

    async def ended(self) -> bytes:
        """What comes until the server closes; fails when it does not."""
        async with asyncio.timeout(WAIT):
            try:
                return await self.reader.read()
            except ConnectionResetError:
                return b""

    async def close(self) -> None:
        """Leave."""
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()


class Server:
    """A server of a test, what it was asked, and what it complained of."""

    def __init__(
        self, handler: Handler | None, limits: HttpLimits, refusal: bytes | None, shares: "Shares"
    ) -> None:
        self.requests: list[HttpRequest] = []
        self.at_once: AtOnce = not_at_once
        self.troubles: list[str] = []
        self.visitors: Visitors[Address] = Visitors(
            _named,
            connections=shares.connections,
            held=shares.held,
            farewells=shares.farewells,
            arriving=shares.arriving,
        )
        self.turns = Turns(shares.requests, _named)
        self.time = ProcessorTime(lambda host: host, shares.clock)
        self._handler = handler
        self.socket = listen("127.0.0.1", 0)
        self.port: int = self.socket.getsockname()[1]
        self.clients: list[Client] = []
        self.http = HttpServer(
            self.socket,
            self._handle,
            at_once=lambda request: self.at_once(request),  # noqa: PLW0108 - the one of that moment
            limits=limits,
            visitors=self.visitors,
            turns=self.turns,
            time=self.time,
            refuse=lambda peer: None if refusal is None else self._refuse,
            troubled=self._complain,
        )
        self.complained = asyncio.Event()
        self._refusal = refusal
        self.beginnings: list[bytes] = []

    def _refuse(self, beginning: bytes) -> bytes:
        self.beginnings.append(beginning)
        assert self._refusal is not None
        return self._refusal

    def _complain(self, _peer: Peer, reason: str) -> None:
        self.troubles.append(reason)
        self.complained.set()

    async def _handle(self, request: HttpRequest) -> bytes:
        self.requests.append(request)
        return (
            await self._handler(request) if self._handler is not None else b"answer to " + request.body[:1000]
        )

    async def connect(self, host: str = "127.0.0.1") -> Client:
        """A new connection from this address, closed at the end of the test."""
        client = Client(*await asyncio.open_connection("127.0.0.1", self.port, local_addr=(host, 0)))
        self.clients.append(client)
        return client

    async def trouble(self) -> str:
        """The first complaint."""
        async with asyncio.timeout(WAIT):
            await self.complained.wait()
        return self.troubles[0]


@contextlib.asynccontextmanager
async def serving(
    handler: Handler | None = None,
    limits: HttpLimits = LIMITS,
    refusal: bytes | None = None,
    shares: "Shares | None" = None,
) -> AsyncIterator[Server]:
    """A running server; afterwards nothing of any client is left in its books."""
    server = Server(handler, limits, refusal, shares or Shares())
    await server.http.start()
    sweep = asyncio.get_running_loop().create_task(server.visitors.sweep())
    try:
        yield server
    finally:
        for client in server.clients:
            await client.close()
        await until(lambda: not server.visitors.connections)
        await until(lambda: not server.visitors.held.total)
        assert server.visitors.connected.total == server.visitors.farewells.total == 0
        sweep.cancel()
        server.http.close()


async def until(condition: Callable[[], bool]) -> None:
    """Return when it holds; the loop goes on meanwhile."""
    async with asyncio.timeout(WAIT):
        while not condition():
            await asyncio.sleep(0.01)


def run(test: Awaitable[Any]) -> None:
    """Run on the loop that control runs on."""

    async def whole() -> None:
        await test

    uvloop.run(whole())


# --- what is served ---


def test_requests_on_one_connection() -> None:
    """A kept-alive connection is served request by request, in order."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            for body in (b"one", b"", b"three"):
                await client.send(post(body))
                status, headers, answer = await client.response()
                assert (status, answer, headers["connection"]) == (200, b"answer to " + body, "keep-alive")

    run(test())


def test_peer_path_and_body() -> None:
    """The handler sees the peer's address, the address he reached us at, the path and the whole body."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(post(b"x" * 100_000, path="/key/"))
            await client.response()
            request = server.requests[0]
            assert (request.peer.text, request.peer.local, request.path) == (
                "127.0.0.1",
                "127.0.0.1",
                "/key/",
            )
            assert request.body == b"x" * 100_000

    run(test())


@pytest.mark.parametrize("size", [1 << 16, 1 << 20, 3 << 20, 16 << 20])
def test_large_bodies(size: int) -> None:
    """Bodies up to the limit are served, one after the other, by length and in chunks."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            for _ in range(2):
                await client.send(post(b"x" * size))
                assert (await client.response())[0] == 200
            await client.send(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n")
            chunk = b"10000\r\n" + b"x" * 0x10000 + b"\r\n"
            await client.send(chunk * (size >> 16) + b"0\r\n\r\n")
            assert (await client.response())[0] == 200
            assert [len(request.body) for request in server.requests] == [size] * 3

    run(test())


def test_pipelined_requests() -> None:
    """Requests sent without waiting are answered one after the other, in order, none twice."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(b"".join(post(b"%d" % number) for number in range(500)))
            for number in range(500):
                assert (await client.response())[2] == b"answer to %d" % number
            assert len(server.requests) == 500

    run(test())


@pytest.mark.parametrize("together", [False, True], ids=["one by one", "in one piece"])
def test_what_can_be_answered_at_once(together: bool) -> None:
    """Such requests and others on one connection are answered in their order, whole or in pieces; nothing is kept."""

    async def slowly(request: HttpRequest) -> bytes:
        await asyncio.sleep(0)
        return b"known" if b"known" in request.body else request.body

    async def test() -> None:
        async with serving(slowly) as server:
            server.at_once = lambda request: b"known" if b"known" in request.body else None
            client = await server.connect()
            bodies = [b"known", b"new", b"known 2" + b"x" * 100_000, b"new 2", b"known 3", *[b"known"] * 300]
            if together:
                await client.send(b"".join(post(body) for body in bodies))
            for body in bodies:
                if not together:
                    await client.send(post(body))
                status, _headers, answer = await client.response()
                assert (status, answer) == (200, b"known" if b"known" in body else body)
            assert [request.body for request in server.requests] == [b"new", b"new 2"] or together

    run(test())


def test_an_answer_at_once_needs_no_slot() -> None:
    """While all slots are taken, a question that needs none is answered: it costs its host processor time only."""

    async def test() -> None:
        go = asyncio.Event()

        async def slow(request: HttpRequest) -> bytes:
            await go.wait()
            return request.body

        async with serving(slow, shares=Shares(requests=Bounds(1, 1, 1, 0))) as server:
            server.at_once = lambda request: b"at once" if request.body == b"known" else None
            first, second, third = [await server.connect() for _ in range(3)]
            await first.send(post(b"one"))
            await until(lambda: bool(server.requests))
            await second.send(post(b"two"))
            await until(lambda: bool(server.turns.waiting))
            await third.send(post(b"known"))
            assert (await third.response())[2] == b"at once"
            go.set()
            assert [(await one.response())[2] for one in (first, second)] == [b"one", b"two"]

    run(test())


def test_requests_of_a_host_that_used_much_wait_for_another_hosts() -> None:
    """Requests of many connections are served by the processor time that their hosts have used, not as they came."""

    async def test() -> None:
        order: list[str] = []
        now = 0.0

        async def costly(request: HttpRequest) -> bytes:
            nonlocal now
            order.append(request.peer.text)
            now += 0.01
            return b""

        async with serving(costly, shares=Shares(clock=lambda: now)) as server:
            guests = [await server.connect() for _ in range(20)]
            robot = await server.connect("127.0.0.2")
            await until(lambda: len(server.http.connections) == 21)
            for client in [*guests, robot]:
                await client.send(post(b"x"))
            for client in [*guests, robot]:
                await client.response()
            assert order.index("127.0.0.2") <= 2
            assert len(order) == 21

    run(test())


@pytest.mark.parametrize("at_once", [False, True])
def test_a_server_that_keeps_no_connection(at_once: bool) -> None:
    """Each answer says that the connection ends, and ends it: ROSMaster checks all it has open at every call."""

    async def test() -> None:
        async with serving() as server:
            server.http.keep = False
            server.at_once = lambda _request: b"known" if at_once else None
            client = await server.connect()
            await client.send(post(b"x") * 2)
            status, headers, _body = await client.response()
            assert (status, headers["connection"]) == (200, "close")
            assert await client.ended() == b""

    run(test())


def test_many_connections_are_accepted_in_one_turn() -> None:
    """Connections that wait in the kernel are accepted many at a time, whatever else the loop does in each turn."""

    async def test() -> None:
        async with serving() as server:
            clients = [socket.socket() for _ in range(50)]
            for client in clients:
                client.connect(("127.0.0.1", server.port))  # the kernel accepts; the loop has not run since
            turns = 0
            while len(server.http.connections) < 50:
                await asyncio.sleep(0)
                turns += 1
            assert turns <= 5
            for client in clients:
                client.close()

    run(test())


def test_connections_that_come_faster_than_they_are_opened() -> None:
    """A host that floods with connections fills its own part of those that wait; another host's is opened at once."""

    async def test() -> None:
        now = 0.0

        def tick() -> float:
            nonlocal now
            now += 0.001
            return now

        async with serving(shares=Shares(arriving=Bounds(40, 20, 10, 10), clock=tick)) as server:
            flood = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(100)]
            robot = await server.connect("127.0.0.2")
            await robot.send(post(b"x"))
            await robot.response()
            assert "the share of one host is 20" in await server.trouble()
            assert server.visitors.connected.held(ipaddress.ip_address("127.0.0.1")) < 100
            for sock in flood:
                sock.close()

    run(test())


def test_byte_by_byte() -> None:
    """A request may arrive in pieces of any size."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            for byte in post(b"slow", "X-Header: value"):
                await client.send(bytes([byte]))
            assert (await client.response())[2] == b"answer to slow"

    run(test())


def test_chunked_body() -> None:
    """A chunked body is one body."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(b"POST / HTTP/1.1\r\nHost: m\r\nTransfer-Encoding: chunked\r\n\r\n")
            await client.send(b"3\r\nabc\r\n4;extension=1\r\ndefg\r\n0\r\nTrailer: yes\r\n\r\n")
            assert (await client.response())[2] == b"answer to abcdefg"

    run(test())


def test_http_1_0_and_connection_close() -> None:
    """Who does not keep the connection gets his answer and the end of the stream."""

    async def test() -> None:
        async with serving() as server:
            for request in (
                b"POST / HTTP/1.0\r\nContent-Length: 1\r\n\r\nx",
                post(b"x", "Connection: close"),
            ):
                client = await server.connect()
                await client.send(request)
                status, headers, body = await client.response()
                assert (status, headers["connection"], body) == (200, "close", b"answer to x")
                assert await client.ended() == b""

    run(test())


def test_expect_100_continue() -> None:
    """Who waits for `100 Continue` gets it."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(post(b"", "Expect: 100-continue", length=4))
            async with asyncio.timeout(WAIT):
                assert await client.reader.readuntil(b"\r\n\r\n") == b"HTTP/1.1 100 Continue\r\n\r\n"
            await client.send(b"body")
            assert (await client.response())[2] == b"answer to body"

    run(test())


def test_a_defect_in_the_handler() -> None:
    """A handler that fails costs its caller an answer `500`; the connection and the server go on."""

    async def handler(request: HttpRequest) -> bytes:
        if request.body == b"bad":
            raise KeyError("a defect")
        return b"good"

    async def test() -> None:
        async with serving(handler) as server:
            client = await server.connect()
            await client.send(post(b"bad") + post(b"fine"))
            assert (await client.response())[0] == 500
            assert (await client.response())[2] == b"good"

    run(test())


def test_a_handler_without_an_answer() -> None:
    """The peer finds its connection reset, not ended in good order; nothing of it stays counted."""

    async def handler(_request: HttpRequest) -> bytes:
        raise NoAnswerError

    async def test() -> None:
        async with serving(handler) as server:
            client = await server.connect()
            await client.send(post(b"x"))
            with pytest.raises(ConnectionResetError):
                await client.reader.readexactly(1)

    run(test())


# --- what is refused ---


@pytest.mark.parametrize(
    ("request_bytes", "status", "reason"),
    [
        (b"GET / HTTP/1.1\r\nHost: m\r\n\r\n", 405, "did not POST"),
        (b"CONNECT m:1 HTTP/1.1\r\nHost: m\r\n\r\n", 405, "did not POST"),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", 400, "not HTTP"),
        (b"\xaf\x00\x00\x00callerid=/x", 400, "not HTTP"),
        (post(b"", length=17 << 20), 413, "announced a body"),
        (post(b"", "Content-Encoding: gzip"), 415, "encoded as 'gzip'"),
        (post(b"", "Connection: upgrade", "Upgrade: h2c"), 501, "another protocol"),
        (b"POST / HTTP/1.1\r\nContent-Length: -5\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: 1e3\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: 3\r\nContent-Length: 4\r\n\r\nabcd", 400, "not HTTP"),
        (
            b"POST / HTTP/1.1\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
            400,
            "not HTTP",
        ),
        (b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nX:" + b"a" * 70_000, 431, "head beyond the limit"),
        (b"POST /" + b"a" * 70_000, 431, "head beyond the limit"),
        (b"POST /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", 431, "head beyond the limit"),
        (b"POST / HTTP/1.1\r\nX: " + b"a" * 70_000 + b"\r\n\r\n", 431, "head beyond the limit"),
        (b"POST / HTTP/1.1\r\n" + b"X: y\r\n" * 20_000, 431, "head beyond the limit"),
    ],
    ids=lambda value: repr(value[:40]) if isinstance(value, bytes) else None,
)
def test_malformed(request_bytes: bytes, status: int, reason: str) -> None:
    """What is not a POST of HTTP within the limits is answered with its status, told, and never served."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(request_bytes)
            code, _headers, body = await client.response()
            assert code == status
            assert reason in fault(body)
            assert await client.ended() == b""
            assert [reason in trouble for trouble in server.troubles] == [True], server.troubles
            assert not server.requests

    run(test())


def test_nothing_is_served_after_a_refusal() -> None:
    """Bytes behind a refused request (smuggled requests among them) are thrown away."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(b"GET / HTTP/1.1\r\nHost: m\r\n\r\n" + post(b"smuggled"))
            assert (await client.response())[0] == 405
            await client.ended()
            assert not server.requests

    run(test())


def test_a_request_before_a_malformed_one_is_answered_or_the_connection_ends() -> None:
    """Rubbish behind a good request ends the connection; the good request was served at most once."""

    async def test() -> None:
        async with serving() as server:
            client = await server.connect()
            await client.send(post(b"good") + b"\x00\x01rubbish\r\n\r\n")
            await client.ended()
            assert len(server.requests) <= 1

    run(test())


def test_large_refused_body_still_gets_its_answer() -> None:
    """A client that sends a large body before it reads learns why it is refused, not just a reset."""

    async def test() -> None:
        async with serving(refusal=b"<fault/>") as server:
            client = await server.connect()
            client.writer.write(post(b"x" * (4 << 20)))
            status, headers, body = await client.response()
            assert (status, headers["connection"], body) == (200, "close", b"<fault/>")
            assert not server.requests
            assert server.beginnings == [b"x" * 4096]

    run(test())


def test_a_refusal_sees_what_was_asked_for() -> None:
    """The beginning of the body is given to what makes the answer, in one piece or in several; nothing is served."""

    async def test() -> None:
        async with serving(refusal=b"<fault/>") as server:
            for pieces in ([post(b"<methodCall/>")], [post(b"", length=13), b"<method", b"Call/>"]):
                client = await server.connect()
                for piece in pieces:
                    await client.send(piece)
                assert (await client.response())[2] == b"<fault/>"
            assert server.beginnings == [b"<methodCall/>"] * 2
            assert not server.requests

    run(test())


def test_who_waits_to_be_asked_for_the_body_is_refused_at_once() -> None:
    """`Expect: 100-continue` of a peer that no rule names is answered with the refusal."""

    async def test() -> None:
        async with serving(refusal=b"<fault/>") as server:
            client = await server.connect()
            await client.send(post(b"", "Expect: 100-continue", length=1000))
            assert (await client.response())[2] == b"<fault/>"

    run(test())


def test_refused_before_the_body() -> None:
    """A peer that no rule names is answered, too, when the rest of its request does not come."""

    async def test() -> None:
        async with serving(refusal=b"<fault/>") as server:
            client = await server.connect()
            await client.send(post(b"", length=1000))
            assert (await client.response())[2] == b"<fault/>"

    run(test())


def test_chunked_body_beyond_the_limit() -> None:
    """A body that never announced its size is cut off at the limit."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, body_bytes=100_000)) as server:
            client = await server.connect()
            await client.send(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n")
            chunk = b"8000\r\n" + b"x" * 0x8000 + b"\r\n"
            for _ in range(5):
                client.writer.write(chunk)
            assert (await client.response())[0] == 413

    run(test())


@pytest.mark.parametrize(
    "framing", [b"1\r\nx\r\n", b"1;" + b"e" * 1000 + b"\r\nx\r\n"], ids=["tiny", "extension"]
)
def test_more_framing_than_body(framing: bytes) -> None:
    """Chunks of one byte, or with endless extensions, are refused long before they cost memory."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, head_bytes=4096, body_bytes=1 << 16)) as server:
            client = await server.connect()
            client.writer.write(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + framing * 20_000)
            assert (await client.response())[0] == 400
            assert "chunk sizes" in await server.trouble()

    run(test())


def test_endless_trailer() -> None:
    """A trailer is part of what a request may have beside its body."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, head_bytes=4096, body_bytes=1 << 16)) as server:
            client = await server.connect()
            client.writer.write(
                b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nX: " + b"a" * 1_000_000
            )
            assert (await client.response())[0] == 400

    run(test())


# --- nobody can hold it ---


@pytest.mark.parametrize(
    "beginning", [b"", b"POST /", b"POST / HTTP/1.1\r\nHost: m\r\nX: "], ids=["silent", "line", "head"]
)
def test_slowloris(beginning: bytes) -> None:
    """A connection whose request head does not come, or comes a byte a time, ends after `head_seconds`."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, head_seconds=0.3)) as server:
            client = await server.connect()
            if beginning:
                await client.send(beginning)
            dripping = asyncio.get_running_loop().create_task(drip(client))
            begun = time.monotonic()
            await client.ended()
            assert time.monotonic() - begun < WAIT
            dripping.cancel()
            assert [("did not finish" in one) for one in server.troubles] == ([True] if beginning else [])

    async def drip(client: Client) -> None:
        with contextlib.suppress(ConnectionError):
            while beginning:
                await client.send(b"a")
                await asyncio.sleep(0.05)

    run(test())


def test_stalled_body() -> None:
    """A body that stops coming ends the connection after `stall_seconds`."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, stall_seconds=0.2)) as server:
            client = await server.connect()
            await client.send(post(b"half", length=100))
            await client.ended()
            assert not server.requests

    run(test())


def test_idle_connection() -> None:
    """A kept connection that asks nothing for `idle_seconds` is closed, without a complaint."""

    async def test() -> None:
        async with serving(limits=replace(LIMITS, idle_seconds=0.2)) as server:
            client = await server.connect()
            await client.send(post(b"x"))
            await client.response()
            assert await client.ended() == b""
            assert not server.troubles

    run(test())


def test_answers_that_are_not_taken() -> None:
    """Who asks on and on without reading is not served on: at most one answer waits for him."""

    async def handler(_request: HttpRequest) -> bytes:
        return b"x" * LARGE

    async def test() -> None:
        async with serving(handler, limits=replace(LIMITS, stall_seconds=0.5)) as server:
            client = await server.connect()
            client.writer.write(post(b"") * 50)
            await until(lambda: len(server.requests) == 1 and bool(server.visitors.held.total))
            assert server.visitors.held.total <= LARGE + 50 * 4200
            await until(lambda: not server.visitors.connections)  # the sweep gives up on him
            assert len(server.requests) == 1

    run(test())


def test_slow_reader_that_moves() -> None:
    """An answer that is taken slowly but steadily is delivered whole."""

    async def handler(_request: HttpRequest) -> bytes:
        return b"x" * (8 << 20)

    async def test() -> None:
        async with serving(handler, limits=replace(LIMITS, stall_seconds=0.4)) as server:
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
            sock.connect(("127.0.0.1", server.port))
            reader, writer = await asyncio.open_connection(sock=sock, limit=65536)
            writer.write(post(b""))
            await reader.readuntil(b"\r\n\r\n")
            taken = 0
            while taken < 8 << 20:
                piece = await asyncio.wait_for(reader.read(200_000), WAIT)
                assert piece, f"cut after {taken} bytes"
                taken += len(piece)
                await asyncio.sleep(0.02)
            writer.close()
            await writer.wait_closed()

    run(test())


def test_next_request_after_a_slow_answer() -> None:
    """When a large answer was taken at last, the connection is served on."""

    async def handler(request: HttpRequest) -> bytes:
        return b"x" * LARGE if request.body == b"large" else b"small"

    async def test() -> None:
        async with serving(handler) as server:
            client = await server.connect()
            await client.send(post(b"large") + post(b"small"))
            await until(lambda: bool(server.visitors.held.total))
            assert len((await client.response())[2]) == LARGE
            assert (await client.response())[2] == b"small"
            await client.send(post(b"again"))
            assert (await client.response())[2] == b"small"

    run(test())


def test_connections_per_host() -> None:
    """One host has so many connections and no more; the others are not touched, and a closed one counts no more."""

    async def test() -> None:
        async with serving(shares=Shares(connections=_of(3))) as server:
            clients = [await server.connect() for _ in range(3)]
            for client in clients:
                await client.send(post(b"x"))
                await client.response()
            status, _headers, body = await (await server.connect()).response()
            assert (status, fault(body)) == (
                503,
                "127.0.0.1 has 3 connections open; the share of one host is 3",
            )
            assert "127.0.0.1 has 3 connections open" in await server.trouble()
            await clients[0].close()
            await until(lambda: server.visitors.connected.total == 2)
            late = await server.connect()
            await late.send(post(b"x"))
            assert (await late.response())[0] == 200

    run(test())


def test_connections_that_are_too_many_do_not_stay() -> None:
    """A few at a time are told why; the others are cut, and so are those that do not leave."""

    async def test() -> None:
        limits, shares = replace(LIMITS, linger_seconds=0.2), Shares(connections=_of(1), farewells=_of(2))
        async with serving(limits=limits, shares=shares) as server:
            first = await server.connect()
            await first.send(post(b"x"))
            await first.response()
            late = [await server.connect() for _ in range(6)]
            told = [(await one.ended())[:12] for one in late]
            assert told.count(b"HTTP/1.1 503") == 2
            assert told.count(b"") == 4
            await until(lambda: len(server.visitors.connections) == 1)
            assert not server.visitors.farewells.total
            assert (await (await server.connect()).response())[0] == 503

    run(test())


def test_bytes_per_host() -> None:
    """Bodies that wait to be answered are bounded per host; one too many is refused, the others are served."""
    release = asyncio.Event()

    async def handler(_request: HttpRequest) -> bytes:
        await release.wait()
        return b"done"

    async def test() -> None:
        async with serving(handler, shares=Shares(held=_of(250_000))) as server:
            clients = [await server.connect() for _ in range(2)]
            for client in clients:
                await client.send(post(b"x" * 100_000))
            await until(lambda: len(server.requests) == 2)
            third = await server.connect()
            await third.send(post(b"x" * 100_000))
            assert (await third.response())[0] == 503
            assert "the share of one host" in await server.trouble()
            release.set()
            for client in clients:
                assert (await client.response())[2] == b"done"

    run(test())


def test_small_requests_that_wait_are_counted() -> None:
    """What came in one piece with a request that is being served waits, and counts for its host like all else."""
    release = asyncio.Event()

    async def handler(_request: HttpRequest) -> bytes:
        await release.wait()
        return b"done"

    async def test() -> None:
        async with serving(handler, shares=Shares(held=_of(100_000))) as server:
            client = await server.connect()
            await client.send(post(b"first"))
            await until(lambda: bool(server.requests))
            await client.send(b"POST / HTTP/1.1\r\n\r\n" * 500)
            assert "the share of one host" in await server.trouble()
            assert len(server.requests) == 1
            release.set()
            await client.close()
            await until(lambda: not server.visitors.held.total)
            again = await server.connect()
            await again.send(b"POST / HTTP/1.1\r\n\r\n" * 20)
            for _ in range(20):
                assert (await again.response())[2] == b"done"

    run(test())


def test_requests_behind_one_that_is_served_are_not_read() -> None:
    """Whoever sends 2,000 requests while one is being answered has one piece of them read; all are answered."""
    release = asyncio.Event()

    async def handler(_request: HttpRequest) -> bytes:
        await release.wait()
        return b"done"

    async def test() -> None:
        async with serving(handler) as server:
            client = await server.connect()
            await client.send(post(b"x") * 2000)
            await until(lambda: bool(server.requests))
            assert server.visitors.held.total < 512 * 5000
            release.set()
            for _ in range(2000):
                assert (await client.response())[2] == b"done"

    run(test())


def test_gone_before_his_turn() -> None:
    """A request whose connection is gone before it was its turn is not served and holds nothing."""
    release = asyncio.Event()

    async def handler(_request: HttpRequest) -> bytes:
        await release.wait()
        return b"done"

    async def test() -> None:
        async with serving(handler, shares=Shares(requests=_of(1))) as server:
            first = await server.connect()
            await first.send(post(b"first"))
            await until(lambda: len(server.requests) == 1)
            for _ in range(20):
                gone = await server.connect()
                await gone.send(post(b"x" * 1000))
                await gone.close()
            await until(lambda: server.visitors.connected.total == 1)
            release.set()
            assert (await first.response())[2] == b"done"
            assert len(server.requests) == 1
            again = await server.connect()
            await again.send(post(b"again"))
            assert (await again.response())[2] == b"done"

    run(test())


# --- addresses and listening ---


@pytest.mark.parametrize(
    ("text", "plain"),
    [("10.0.0.1", "10.0.0.1"), ("::ffff:10.0.0.1", "10.0.0.1"), ("fe80::1%eth0", "fe80::1"), ("::1", "::1")],
)
def test_plain_address(text: str, plain: str) -> None:
    """An IPv4 peer of an IPv6 socket is the IPv4 host that the policy names."""
    assert plain_address(text) == ipaddress.ip_address(plain)


def test_listen_on_both_families() -> None:
    """`::` takes IPv4 peers as well."""
    with listen("::", 0) as sock, socket.create_connection(("127.0.0.1", sock.getsockname()[1]), WAIT):
        accepted, address = sock.accept()
        accepted.close()
        assert plain_address(address[0]) == ipaddress.ip_address("127.0.0.1")


def test_listen_where_somebody_listens() -> None:
    """A port in use is an error, and no socket is left open."""
    with listen("127.0.0.1", 0) as sock, pytest.raises(OSError, match="in use"):
        listen("127.0.0.1", sock.getsockname()[1])
