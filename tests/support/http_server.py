import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from functools import partial

import pytest

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import (
    RVMASTER_ARRIVALS,
    RVMASTER_BYTES,
    RVMASTER_CONNECTIONS,
    RVMASTER_FAREWELLS,
    RVMASTER_REQUESTS,
)
from appliance.rpc.acceptor import Program
from appliance.rpc.connection_table import ConnectionTable, Patience
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler, HttpRequest, HttpServer, Peer, listen
from roswire.xmlrpc import FaultReceived, parse_response
from tests.support.waiting import until

LIMITS = HttpLimits()
WAIT = 20.0
LARGE = 24 << 20  # more than the kernel's buffers take


def two_hosts(host: int) -> Bounds:
    return Bounds(whole=2 * host, host=host, unknown=0, kept=0)


def _named(_host: object) -> QuotaClass:
    return QuotaClass.NAMED


@dataclass(frozen=True)
class Shares:
    connections: Bounds = RVMASTER_CONNECTIONS.bounds
    held: Bounds = RVMASTER_BYTES.bounds
    farewells: Bounds = RVMASTER_FAREWELLS.bounds
    requests: Bounds = RVMASTER_REQUESTS.bounds
    arriving: Bounds = RVMASTER_ARRIVALS.bounds
    clock: Callable[[], float] = time.thread_time
    first: Program | None = None
    patience: Patience | None = None


def post(body: bytes, *headers: str, path: str = "/", length: int | None = None) -> bytes:
    lines = [
        f"POST {path} HTTP/1.1",
        "Host: master",
        f"Content-Length: {len(body) if length is None else length}",
    ]
    return "\r\n".join([*lines, *headers, "", ""]).encode() + body


def fault(body: bytes) -> str:
    with pytest.raises(FaultReceived) as received:
        parse_response(body)
    return received.value.text


class Client:
    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def send(self, data: bytes) -> None:
        self.writer.write(data)
        await self.writer.drain()

    async def response(self) -> tuple[int, dict[str, str], bytes]:
        async with asyncio.timeout(WAIT):
            head = (await self.reader.readuntil(b"\r\n\r\n")).decode()
            status, *lines = head.strip().split("\r\n")
            headers = {line.split(": ")[0].lower(): line.split(": ")[1] for line in lines}
            body = await self.reader.readexactly(int(headers.get("content-length", "0")))
        return int(status.split()[1]), headers, body

    async def ended(self) -> bytes:
        async with asyncio.timeout(WAIT):
            try:
                return await self.reader.read()
            except ConnectionResetError:
                return b""

    async def close(self) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()


class Server:
    def __init__(
        self, handler: Handler | None, limits: HttpLimits, refusal: bytes | None, shares: "Shares"
    ) -> None:
        self.requests: list[HttpRequest] = []
        self.troubles: list[str] = []
        table = (
            partial(ConnectionTable[Address], patience=shares.patience)
            if shares.patience
            else ConnectionTable
        )
        self.connection_table: ConnectionTable[Address] = table(
            _named,
            connections=shares.connections,
            held=shares.held,
            farewells=shares.farewells,
            arriving=shares.arriving,
        )
        self.turns: Turns[Address] = Turns(shares.requests, _named)
        self.time = ProcessorTime(lambda host: host, shares.clock)
        self._handler = handler
        self.socket = listen("127.0.0.1", 0)
        self.port: int = self.socket.getsockname()[1]
        self.clients: list[Client] = []
        self.http = HttpServer(
            self.socket,
            self._handle,
            limits=limits,
            connection_table=self.connection_table,
            turns=self.turns,
            time=self.time,
            first=shares.first,
            refuse=lambda peer: None if refusal is None else self._refuse,
            troubled=self._complain,
            malformed=self._complain,
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
        client = Client(*await asyncio.open_connection("127.0.0.1", self.port, local_addr=(host, 0)))
        self.clients.append(client)
        return client

    async def trouble(self) -> str:
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
    server = Server(handler, limits, refusal, shares or Shares())
    await server.http.start()
    sweep = asyncio.get_running_loop().create_task(server.connection_table.sweep())
    try:
        yield server
    finally:
        for client in server.clients:
            await client.close()
        await until(lambda: not server.connection_table.connections)
        await until(lambda: not server.connection_table.held.total)
        assert server.connection_table.connected.total == server.connection_table.farewells.total == 0
        sweep.cancel()
        server.http.close()
