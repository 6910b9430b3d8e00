import asyncio
import contextlib
import socket
from dataclasses import replace

import pytest

from appliance.base import clock
from appliance.rpc.server import Handler, HttpRequest
from tests.support.http_server import (
    LARGE,
    LIMITS,
    WAIT,
    Client,
    Shares,
    fault,
    post,
    serving,
    two_hosts,
)
from tests.support.waiting import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


@pytest.mark.parametrize(
    "beginning", [b"", b"POST /", b"POST / HTTP/1.1\r\nHost: m\r\nX: "], ids=["silent", "line", "head"]
)
async def test_slowloris(beginning: bytes) -> None:
    async def drip(client: Client) -> None:
        with contextlib.suppress(ConnectionError):
            while beginning:
                await client.send(b"a")
                await asyncio.sleep(0.05)

    async with serving(limits=replace(LIMITS, head_seconds=0.3)) as server:
        client = await server.connect()
        if beginning:
            await client.send(beginning)
        dripping = asyncio.get_running_loop().create_task(drip(client))
        begun = clock.now()
        await client.ended()
        assert clock.now() - begun < WAIT
        dripping.cancel()
        assert [("did not finish" in trouble) for trouble in server.troubles] == ([True] if beginning else [])


async def test_stalled_body() -> None:
    async with serving(limits=replace(LIMITS, stall_seconds=0.2)) as server:
        client = await server.connect()
        await client.send(post(b"half", length=100))
        await client.ended()
        assert not server.requests


async def test_idle_connection() -> None:
    async with serving(limits=replace(LIMITS, idle_seconds=0.2)) as server:
        client = await server.connect()
        await client.send(post(b"x"))
        await client.response()
        assert await client.ended() == b""
        assert not server.troubles


async def test_answers_that_are_not_taken() -> None:
    async def handler(_request: HttpRequest) -> bytes:
        return b"x" * LARGE

    async with serving(handler, limits=replace(LIMITS, stall_seconds=0.5)) as server:
        client = await server.connect()
        client.writer.write(post(b"") * 50)
        await until(lambda: len(server.requests) == 1 and bool(server.connection_table.held.total))
        assert server.connection_table.held.total <= LARGE + 50 * 4200
        await until(lambda: not server.connection_table.connections)  # the sweep gives up on it
        assert len(server.requests) == 1


async def test_slow_reader_that_moves() -> None:
    async def handler(_request: HttpRequest) -> bytes:
        return b"x" * (8 << 20)

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


async def test_next_request_after_a_slow_answer() -> None:
    async def handler(request: HttpRequest) -> bytes:
        return b"x" * LARGE if request.body == b"large" else b"small"

    async with serving(handler) as server:
        client = await server.connect()
        await client.send(post(b"large") + post(b"small"))
        await until(lambda: bool(server.connection_table.held.total))
        assert len((await client.response())[2]) == LARGE
        assert (await client.response())[2] == b"small"
        await client.send(post(b"again"))
        assert (await client.response())[2] == b"small"


async def test_connections_per_host() -> None:
    async with serving(shares=Shares(connections=two_hosts(3))) as server:
        clients = [await server.connect() for _ in range(3)]
        for client in clients:
            await client.send(post(b"x")[:-1])  # an idle one would make room
        await until(lambda: server.connection_table.connected.total == 3)
        status, _headers, body = await (await server.connect()).response()
        assert (status, fault(body)) == (503, "127.0.0.1 has 3 connections open; the quota of one host is 3")
        assert "127.0.0.1 has 3 connections open" in await server.trouble()
        await clients[0].close()
        await until(lambda: server.connection_table.connected.total == 2)
        late = await server.connect()
        await late.send(post(b"x"))
        assert (await late.response())[0] == 200


async def test_connections_that_are_too_many_do_not_stay() -> None:
    limits, shares = (
        replace(LIMITS, linger_seconds=0.2),
        Shares(connections=two_hosts(1), farewells=two_hosts(2)),
    )
    async with serving(limits=limits, shares=shares) as server:
        first = await server.connect()
        await first.send(post(b"x")[:-1])  # an idle one would make room
        await until(lambda: server.connection_table.connected.total == 1)
        late = [await server.connect() for _ in range(6)]
        told = [(await one.ended())[:12] for one in late]
        assert told.count(b"HTTP/1.1 503") == 2
        assert told.count(b"") == 4
        await until(lambda: len(server.connection_table.connections) == 1)
        assert not server.connection_table.farewells.total
        assert (await (await server.connect()).response())[0] == 503


def answering_after(release: asyncio.Event) -> Handler:
    async def handler(_request: HttpRequest) -> bytes:
        await release.wait()
        return b"done"

    return handler


async def test_bytes_per_host() -> None:
    release = asyncio.Event()
    async with serving(answering_after(release), shares=Shares(held=two_hosts(250_000))) as server:
        clients = [await server.connect() for _ in range(2)]
        for client in clients:
            await client.send(post(b"x" * 100_000))
        await until(lambda: len(server.requests) == 2)
        third = await server.connect()
        await third.send(post(b"x" * 100_000))
        assert (await third.response())[0] == 503
        assert "the quota of one host" in await server.trouble()
        release.set()
        for client in clients:
            assert (await client.response())[2] == b"done"


async def test_small_requests_that_wait_are_counted() -> None:
    release = asyncio.Event()
    async with serving(answering_after(release), shares=Shares(held=two_hosts(100_000))) as server:
        client = await server.connect()
        await client.send(post(b"first"))
        await until(lambda: bool(server.requests))
        await client.send(b"POST / HTTP/1.1\r\n\r\n" * 500)
        assert "the quota of one host" in await server.trouble()
        assert len(server.requests) == 1
        release.set()
        await client.close()
        await until(lambda: not server.connection_table.held.total)
        again = await server.connect()
        await again.send(b"POST / HTTP/1.1\r\n\r\n" * 20)
        for _ in range(20):
            assert (await again.response())[2] == b"done"


async def test_requests_behind_one_that_is_served_are_not_read() -> None:
    release = asyncio.Event()
    async with serving(answering_after(release)) as server:
        client = await server.connect()
        await client.send(post(b"x") * 2000)
        await until(lambda: bool(server.requests))
        assert server.connection_table.held.total < 512 * 5000
        release.set()
        for _ in range(2000):
            assert (await client.response())[2] == b"done"


async def test_gone_before_its_turn() -> None:
    release = asyncio.Event()
    async with serving(answering_after(release), shares=Shares(requests=two_hosts(1))) as server:
        first = await server.connect()
        await first.send(post(b"first"))
        await until(lambda: len(server.requests) == 1)
        for _ in range(20):
            gone = await server.connect()
            await gone.send(post(b"x" * 1000))
            await gone.close()
        await until(lambda: server.connection_table.connected.total == 1)
        release.set()
        assert (await first.response())[2] == b"done"
        assert len(server.requests) == 1
        again = await server.connect()
        await again.send(post(b"again"))
        assert (await again.response())[2] == b"done"
