import asyncio
import contextlib
import datetime
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from appliance.api.front.certificate import tls_context
from appliance.api.front.listener import Listener
from appliance.configuration.settings import ApiLimits
from appliance.quotas.pool import QuotaClass
from tests.support.determinism import may_depend_on_chance

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


@pytest.fixture
def anyio_backend(
    request: pytest.FixtureRequest, anyio_backend: tuple[str, dict[str, Any]]
) -> tuple[str, dict[str, Any]]:
    return ("asyncio", {"use_uvloop": True}) if may_depend_on_chance(request.node) else anyio_backend


REQUEST = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
Connect = Callable[[], Awaitable[tuple[asyncio.StreamReader, asyncio.StreamWriter]]]


async def application(scope: Scope, receive: Receive, send: Send) -> None:
    await PlainTextResponse(scope["path"])(scope, receive, send)


@contextlib.asynccontextmanager
async def listening(limits: ApiLimits) -> AsyncIterator[Connect]:
    sock = socket.create_server(("127.0.0.1", 0))
    listener = Listener(application, limits, lambda _peer: QuotaClass.REGISTERED)
    await listener.start(sock, None)
    writers: list[asyncio.StreamWriter] = []

    async def connect() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection(*sock.getsockname())
        writers.append(writer)
        return reader, writer

    try:
        async with asyncio.timeout(30):
            yield connect
    finally:
        for writer in writers:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        await listener.stop()


async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
    try:
        writer.write(REQUEST)
        await writer.drain()
        line = await reader.readline()
        return line.startswith(b"HTTP/1.1 200")
    except ConnectionError:
        return False


async def cut_off(reader: asyncio.StreamReader) -> bool:
    try:
        return await reader.read(1) == b""
    except ConnectionError:
        return True


async def test_connections_of_one_host_are_limited() -> None:
    async with listening(ApiLimits(connections_per_host=3)) as connect:
        first = [await connect() for _ in range(3)]
        assert all([await served(*one) for one in first])
        assert not await served(*await connect())
        first[0][1].close()
        while not await served(*await connect()):
            pass


async def test_connections_of_all_hosts_are_limited() -> None:
    async with listening(ApiLimits(connections=2, connections_per_host=50)) as connect:
        assert all([await served(*await connect()) for _ in range(2)])
        assert not await served(*await connect())


async def test_unfinished_headers_are_cut_off() -> None:
    async with listening(ApiLimits(header_seconds=2)) as connect:
        later = await connect()
        assert await served(*later)
        await later[0].readuntil(b"\r\n\r\n")
        await later[0].readexactly(1)
        slow = await connect()
        slow[1].write(REQUEST[:20])
        later[1].write(REQUEST[:20])
        assert await cut_off(slow[0])
        assert await cut_off(later[0])
        assert await served(*await connect())


async def test_endless_headers_are_cut_off() -> None:
    async with listening(ApiLimits()) as connect:
        reader, writer = await connect()
        writer.write(REQUEST[:16])
        try:
            for _ in range(10_000):
                writer.write(b"X-A: " + b"x" * 1000 + b"\r\n")
                await writer.drain()
        except ConnectionError:
            pass
        else:
            raise AssertionError("ten megabytes of headers were taken")
        reader, writer = await connect()
        writer.write(REQUEST[:-2] + b"X-B: " + b"y" * 100_000 + b"\r\n\r\n")
        told = await reader.read()
        assert told.startswith(b"HTTP/1.1 400")
        assert told.endswith(b"The peer sent a request head beyond the limit.\n")
        reader, writer = await connect()
        writer.write(REQUEST[:-2] + b"X-B: " + b"y" * 50_000 + b"\r\n\r\n")
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")


async def test_many_requests_on_one_connection_are_served() -> None:
    async with listening(ApiLimits()) as connect:
        reader, writer = await connect()
        for _ in range(200):
            writer.write(REQUEST[:-2] + b"X-C: " + b"z" * 2000 + b"\r\n\r\n")
            assert (await reader.readline()).startswith(b"HTTP/1.1 200")
            await reader.readuntil(b"\r\n\r\n")
            assert await reader.readexactly(1) == b"/"


async def answered(connect: Connect, request: bytes) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await connect()
    writer.write(request)
    await reader.readuntil(b"\r\n\r\n")
    assert await reader.readexactly(1) == b"/"
    return reader, writer


async def test_data_after_an_answer_keeps_no_connection_open() -> None:
    async with listening(ApiLimits(header_seconds=1.0)) as connect:
        empty = await answered(connect, REQUEST)
        body = await answered(connect, REQUEST[:-2] + b"Content-Length: 1000000\r\n\r\n")
        begun = await answered(connect, REQUEST)
        empty[1].write(b"\r\n")
        body[1].write(b"x" * 100_000)
        begun[1].write(b"\r\n")
        begun[1].write(REQUEST)
        assert (await begun[0].readline()).startswith(b"HTTP/1.1 200")
        assert await cut_off(empty[0])
        assert await cut_off(body[0])


async def test_the_rest_of_a_body_does_not_close_the_connection() -> None:
    async with listening(ApiLimits()) as connect:
        reader, writer = await answered(connect, REQUEST[:-2] + b"Content-Length: 300000\r\n\r\n")
        for _ in range(3):
            writer.write(b"x" * 100_000)
            await writer.drain()
        assert await served(reader, writer)


async def test_pipelined_requests_are_limited() -> None:
    async with listening(ApiLimits()) as connect:
        reader, writer = await connect()
        writer.write(REQUEST * 10)
        for _ in range(10):
            await reader.readuntil(b"\r\n\r\n")
            assert await reader.readexactly(1) == b"/"
        writer.write(b"GET / HTTP/1.1\r\n\r\n" * 3000)
        text = await reader.read()
        assert b"HTTP/1.1 400" in text
        assert text.count(b"HTTP/1.1 200") < 100


@pytest.mark.timeout(30)
async def test_unknown_hosts_in_the_handshake_make_room(tmp_path: Path) -> None:
    context = tls_context(tmp_path, [], datetime.datetime.now(datetime.UTC))
    known = {"127.0.0.1"}
    listener = Listener(
        application,
        ApiLimits(connections=16, connections_per_host=12),
        lambda peer: QuotaClass.REGISTERED if peer in known else QuotaClass.UNKNOWN,
    )
    sock = socket.create_server(("127.0.0.1", 0))
    where = sock.getsockname()
    await listener.start(sock, context)
    silent = [socket.create_connection(where, source_address=(f"127.0.1.{n}", 0)) for n in range(1, 61)]
    trust = ssl.create_default_context(cafile=tmp_path / "certificate.pem")
    trust.check_hostname = False
    pool = listener.connection_table.connected
    try:
        for _ in range(12):
            reader, writer = await asyncio.open_connection(*where, ssl=trust)
            assert await served(reader, writer)
            assert pool.held_by(QuotaClass.UNKNOWN) <= 6
            assert pool.total <= 16
        assert pool.held("127.0.0.1") == 12
    finally:
        for one in silent:
            one.close()
        await listener.stop()


@pytest.mark.timeout(30)
async def test_a_failed_handshake_frees_its_slot(tmp_path: Path) -> None:
    async def at_end(peer: socket.socket) -> bool:
        peer.setblocking(False)
        try:
            return await asyncio.get_running_loop().sock_recv(peer, 1) == b""
        except ConnectionError:
            return True

    context = tls_context(tmp_path, [], datetime.datetime.now(datetime.UTC))
    listener = Listener(application, ApiLimits(header_seconds=0.3), lambda _peer: QuotaClass.UNKNOWN)
    sock = socket.create_server(("127.0.0.1", 0))
    where = sock.getsockname()
    await listener.start(sock, context)
    peers = [socket.create_connection(where) for _ in range(3)]
    peers[0].sendall(b"GET / HTTP/1.1\r\n\r\n")
    peers[1].sendall(b"\x16\x03\x01")
    peers[1].close()
    await asyncio.sleep(0)
    while listener.connection_table.connected.total or not await at_end(peers[2]):
        await asyncio.sleep(0.01)
    for peer in peers:
        peer.close()
    await listener.stop()


async def test_a_known_peer_is_opened_before_waiting_unknown_hosts() -> None:
    opened: list[str] = []

    class Noting(Listener):
        def protocol_of(self, connection: Any) -> asyncio.Protocol:
            opened.append(connection.transport.get_extra_info("peername")[0])
            return super().protocol_of(connection)

    sock = socket.create_server(("127.0.0.1", 0), backlog=128)
    known = {"127.0.0.99": QuotaClass.NAMED}
    listener = Noting(application, ApiLimits(), lambda peer: known.get(peer, QuotaClass.UNKNOWN))
    addresses = [*(f"127.0.0.{number}" for number in range(10, 60)), "127.0.0.99"]
    clients = [socket.create_connection(sock.getsockname(), source_address=(one, 0)) for one in addresses]
    await listener.start(sock, None)
    async with asyncio.timeout(30):
        while len(opened) < len(addresses):
            await asyncio.sleep(0)
    for client in clients:
        client.close()
    await listener.stop()
    assert opened.index("127.0.0.99") <= 3
