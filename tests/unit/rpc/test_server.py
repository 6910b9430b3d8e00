import asyncio
import ipaddress
import math
import socket

import pytest

from appliance.quotas.pool import Bounds, QuotaClass
from appliance.rpc.acceptor import first_for
from appliance.rpc.connection_table import Stage
from appliance.rpc.processor_time import TURN_SECONDS
from appliance.rpc.server import HttpRequest, NoAnswerError
from tests.support.http_server import WAIT, Client, Server, Shares, post, serving
from tests.support.waiting import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


async def test_requests_on_one_connection(client: Client) -> None:
    for body in (b"one", b"", b"three"):
        await client.send(post(body))
        status, headers, answer = await client.response()
        assert (status, answer, headers["connection"]) == (200, b"answer to " + body, "keep-alive")


async def test_peer_path_and_body(server: Server, client: Client) -> None:
    await client.send(post(b"x" * 100_000, path="/key/"))
    await client.response()
    request = server.requests[0]
    assert (request.peer.text, request.peer.local, request.path) == ("127.0.0.1", "127.0.0.1", "/key/")
    assert request.body == b"x" * 100_000


@pytest.mark.parametrize("size", [1 << 16, 1 << 20, 3 << 20, 16 << 20])
async def test_large_bodies(size: int, server: Server, client: Client) -> None:
    for _ in range(2):
        await client.send(post(b"x" * size))
        assert (await client.response())[0] == 200
    await client.send(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n")
    chunk = b"10000\r\n" + b"x" * 0x10000 + b"\r\n"
    await client.send(chunk * (size >> 16) + b"0\r\n\r\n")
    assert (await client.response())[0] == 200
    assert [len(request.body) for request in server.requests] == [size] * 3


@pytest.mark.parametrize("together", [False, True], ids=["one by one", "in one piece"])
async def test_requests_that_wait_and_others_are_answered_in_order(together: bool) -> None:
    async def sometimes_slow(request: HttpRequest) -> bytes:
        if request.body.startswith(b"slow"):
            await asyncio.sleep(0)
        return request.body

    async with serving(sometimes_slow) as server:
        client = await server.connect()
        bodies = [b"one", b"slow", b"two" + b"x" * 100_000, b"slow 2", b"three"]
        bodies += [b"%d" % number for number in range(500)]
        if together:
            await client.send(b"".join(post(body) for body in bodies))
        for body in bodies:
            if not together:
                await client.send(post(body))
            assert (await client.response())[::2] == (200, body)
        assert server.connection_table.held.total == 0


async def test_the_bytes_of_a_request_count_while_it_waits() -> None:
    go, held = asyncio.Event(), list[int]()

    async def slow(request: HttpRequest) -> bytes:
        held.append(server.connection_table.held.total)
        if request.body != b"quick":
            await go.wait()
        return request.body

    few = Shares(requests=Bounds(1, 1, 1, 0), held=Bounds(13_000, 13_000, 0, 0))
    async with serving(slow, shares=few) as server:
        quick, served, first, second, third = [await server.connect() for _ in range(5)]
        await quick.send(post(b"quick"))
        assert (await quick.response())[2] == b"quick"
        assert held == [0]  # a request that waits for nothing does not count
        await served.send(post(b"served"))
        await until(lambda: server.connection_table.held.total > 4096)
        await first.send(post(b"first"))
        await until(lambda: server.connection_table.held.total > 2 * 4096)
        await second.send(post(b"second"))
        await until(lambda: server.connection_table.held.total > 3 * 4096)
        await third.send(post(b"third"))
        status, _headers, _body = await third.response()
        assert status == 503
        assert "sent a request while" in await server.trouble()
        go.set()
        assert [(await one.response())[2] for one in (served, first, second)] == [
            b"served", b"first", b"second",
        ]  # fmt: skip
        assert server.connection_table.held.total == 0
        assert [request.body for request in server.requests] == [b"quick", b"served", b"first", b"second"]


async def test_a_request_with_a_slot_is_served_while_there_are_too_many_bytes() -> None:
    async def slow(request: HttpRequest) -> bytes:
        await asyncio.sleep(0)
        return b"%d" % server.connection_table.held.total

    async with serving(slow, shares=Shares(held=Bounds(1000, 1000, 0, 0))) as server:
        client = await server.connect()
        await client.send(post(b"x"))
        assert int((await client.response())[2]) > 4096
        assert server.connection_table.held.total == 0


async def test_requests_of_a_host_that_used_much_wait_for_another_hosts() -> None:
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


async def test_a_server_that_keeps_no_connection(server: Server) -> None:
    server.http.keep = False
    client = await server.connect()
    await client.send(post(b"x") * 2)
    status, headers, _body = await client.response()
    assert (status, headers["connection"]) == (200, "close")
    assert await client.ended() == b""


async def test_many_connections_are_accepted_in_one_turn(server: Server) -> None:
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


async def test_connections_that_come_faster_than_they_are_opened() -> None:
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
        assert "the quota of one host is 20" in await server.trouble()
        assert server.connection_table.connected.held(ipaddress.ip_address("127.0.0.1")) < 100
        for sock in flood:
            sock.close()


@pytest.mark.nightly  # the kernel chooses among connections over TCP
async def test_unknown_hosts_that_came_before_a_named_one() -> None:
    program = first_for([ipaddress.ip_network("127.0.0.2")])
    now = 0.0

    def tick() -> float:
        nonlocal now
        now += 0.001
        return now

    async with serving(shares=Shares(clock=tick, first=lambda: program)) as server:
        flood = [
            socket.create_connection(
                ("127.0.0.1", server.port), WAIT, source_address=(f"127.0.3.{number % 200}", 0)
            )
            for number in range(1000)
        ]
        robot = await server.connect("127.0.0.2")
        await robot.send(post(b"x"))
        assert (await robot.response())[0] == 200
        assert len(server.http.connections) + server.connection_table.arriving.total < 500
        await until(lambda: len(server.http.connections) == 1001)
        for sock in flood:
            sock.close()


@pytest.mark.nightly
@pytest.mark.parametrize("later", [False, True])
async def test_a_program_that_the_kernel_refuses(later: bool) -> None:
    wrong = bytes(8)
    program = first_for([ipaddress.ip_network("127.0.0.2")]) if later else wrong
    async with serving(shares=Shares(first=lambda: program)) as server:
        program = wrong
        for host in ("127.0.0.2", "127.0.0.3", "127.0.0.2", "127.0.0.3"):
            client = await server.connect(host)
            await client.send(post(b"x"))
            assert (await client.response())[0] == 200


async def test_connections_that_ended_before_they_are_opened() -> None:
    bounds = Bounds(whole=1, host=1, unknown=0, kept=0)
    async with serving(shares=Shares(connections=bounds)) as server:
        for _ in range(50):
            socket.create_connection(("127.0.0.1", server.port), WAIT).close()
        robot = await server.connect("127.0.0.2")
        await robot.send(post(b"x"))
        assert (await robot.response())[0] == 200
        assert server.troubles == []


async def test_byte_by_byte(client: Client) -> None:
    for byte in post(b"slow", "X-Header: value"):
        await client.send(bytes([byte]))
    assert (await client.response())[2] == b"answer to slow"


async def test_chunked_body(client: Client) -> None:
    await client.send(b"POST / HTTP/1.1\r\nHost: m\r\nTransfer-Encoding: chunked\r\n\r\n")
    await client.send(b"3\r\nabc\r\n4;extension=1\r\ndefg\r\n0\r\nTrailer: yes\r\n\r\n")
    assert (await client.response())[2] == b"answer to abcdefg"


async def test_http_1_0_and_connection_close(server: Server) -> None:
    for request in (b"POST / HTTP/1.0\r\nContent-Length: 1\r\n\r\nx", post(b"x", "Connection: close")):
        client = await server.connect()
        await client.send(request)
        status, headers, body = await client.response()
        assert (status, headers["connection"], body) == (200, "close", b"answer to x")
        assert await client.ended() == b""


async def test_expect_100_continue(client: Client) -> None:
    await client.send(post(b"", "Expect: 100-continue", length=4))
    async with asyncio.timeout(WAIT):
        assert await client.reader.readuntil(b"\r\n\r\n") == b"HTTP/1.1 100 Continue\r\n\r\n"
    await client.send(b"body")
    assert (await client.response())[2] == b"answer to body"


async def test_a_defect_in_the_handler() -> None:
    async def handler(request: HttpRequest) -> bytes:
        if request.body == b"bad":
            raise KeyError("a defect")
        return b"good"

    async with serving(handler) as server:
        client = await server.connect()
        await client.send(post(b"bad") + post(b"fine"))
        assert (await client.response())[0] == 500
        assert (await client.response())[2] == b"good"


async def test_a_handler_without_an_answer() -> None:
    async def handler(_request: HttpRequest) -> bytes:
        raise NoAnswerError

    async with serving(handler) as server:
        client = await server.connect()
        await client.send(post(b"x"))
        with pytest.raises(ConnectionResetError):
            await client.reader.readexactly(1)


async def test_pieces_that_arrive_while_a_host_waits_for_its_turn_are_read_in_order() -> None:
    now = 0.0

    def work() -> None:
        nonlocal now
        now += TURN_SECONDS

    async with serving(shares=Shares(clock=lambda: now)) as server:
        client, other = await server.connect(), ipaddress.ip_address("10.0.0.66")
        request = post(bytes(range(256)))
        await client.send(request[:20])
        await until(lambda: not server.time.waiting)
        server.time.charge_beside(ipaddress.ip_address("127.0.0.1"), 1000 * TURN_SECONDS)
        for _ in range(100):
            server.time.run(other, work)
        for start in range(20, len(request), 50):
            await client.send(request[start : start + 50])
            for _ in range(3):
                await asyncio.sleep(0)
        assert server.time.waiting > 1
        assert not server.requests
        await client.response()
        assert [one.body for one in server.requests] == [bytes(range(256))]


async def test_a_request_that_has_begun_keeps_its_connection_for_a_while() -> None:
    async def handler(request: HttpRequest) -> bytes:
        return request.body

    async with serving(handler, shares=Shares(connections=Bounds(1, 1, 0, 0))) as server:
        client = await server.connect()
        await client.send(post(b"first"))
        await client.response()
        request = post(b"second")
        await client.send(request[:20])
        await until(lambda: any(connection.in_request for connection in server.http.connections))
        other = await server.connect("127.0.0.2")
        assert (await other.response())[0] == 503
        await client.send(request[20:])
        assert (await client.response())[0] == 200


async def test_a_request_in_service_keeps_its_connection() -> None:
    begun, go = asyncio.Event(), asyncio.Event()

    async def handler(request: HttpRequest) -> bytes:
        begun.set()
        await go.wait()
        return b"answer to " + request.body

    def patience(_quota_class: QuotaClass, stage: Stage, _own: bool) -> float:
        return math.inf if stage is Stage.SERVED else 0.0

    shares = Shares(connections=Bounds(1, 1, 0, 0), patience=patience)
    async with serving(handler, shares=shares) as server:
        client = await server.connect()
        await client.send(post(b"robot"))
        async with asyncio.timeout(WAIT):
            await begun.wait()
        other = await server.connect("127.0.0.2")
        assert (await other.response())[0] == 503
        go.set()
        status, _headers, answer = await client.response()
        assert (status, answer) == (200, b"answer to robot")
        third = await server.connect("127.0.0.2")  # the first connection is idle, and makes room
        await third.send(post(b"third"))
        assert (await third.response())[0] == 200
