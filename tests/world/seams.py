"""The replacements for the product's sockets, threads and random numbers.

A descriptor is the object itself: a listening socket or an end of a link, which messages carry to other processes.
"""

import asyncio
import contextlib
import secrets
from collections.abc import Callable, Iterator
from functools import partial
from random import Random
from types import SimpleNamespace
from typing import Any

from appliance.audit.log import log_database, log_writer
from appliance.audit.log.log import AuditLog
from appliance.base import clock
from appliance.channel import child_process
from appliance.control import control, process
from appliance.control.assembly import listener_limits
from appliance.control.links import supervisor_link
from appliance.features.standby import passive, replica, replication
from appliance.features.standby import process as lease_process
from appliance.features.standby.replica_sync import StateComparison
from appliance.features.standby.replication_frames import ReplicationError
from appliance.features.standby.replication_receiver import ReplicationReceiver
from appliance.features.standby.replication_sender import ReplicationSender
from appliance.master import rosmaster
from appliance.rpc.server import Handler, HttpRequest, Peer, Refusal
from appliance.rpc.xmlrpc_client import XmlRpcClient
from appliance.store import changes, writer_thread
from appliance.store.state_file import StateStore
from tests.world import disk
from tests.world.loop import present_process
from tests.world.network import Network
from tests.world.streams import Streams


class Socket:
    def __init__(self, host: str, port: int) -> None:
        self.address = host, port

    def getsockname(self) -> tuple[str, int]:
        return self.address

    def dup(self) -> "Socket":
        return self

    detach = fileno = dup

    def close(self) -> None: ...


class _Server:
    """A server to which the network passes each request. The limits of `HttpServer` are not part of the world."""

    def __init__(self, network: Network, sock: Socket, handler: Handler, **limits: Any) -> None:
        self._network = network
        self._address = sock.address
        self._handler = handler
        self._refuse: Callable[[Peer], Refusal | None] = limits["refuse"]

    async def start(self) -> None:
        self._network.serve(self._address, self._answer)

    def close(self) -> None:
        self._network.stop(self._address)

    async def _answer(self, peer: Peer, body: bytes) -> bytes:
        refusal = self._refuse(peer)
        if refusal is not None:
            return refusal(body)
        return await self._handler(HttpRequest(peer, "/", body, clock.now_ns()))


class _AdminServer:
    def __init__(self, administration: Any) -> None:
        self._administration = administration

    async def start(self, sock: Any) -> "_AdminServer":
        sock.administration = self._administration, present_process()
        return self

    def close(self) -> None: ...


def _make_control(*given: Any) -> Any:
    made = control.Control(*given)
    present_process().made(made)
    return made


@contextlib.contextmanager
def _listening(address: tuple[str, int], **_options: Any) -> Iterator[Socket]:
    yield Socket(*address)


async def _forever() -> None:
    await asyncio.get_running_loop().create_future()


def _handle(descriptor: Any = None, *_given: Any, **named: Any) -> Any:
    return named.get("fileno", descriptor)


class _Listener:
    def __init__(
        self, streams: Streams, server: ReplicationSender | StateComparison, _context: object
    ) -> None:
        self._streams = streams
        self._server = server

    async def run(self, listening: Socket) -> None:
        await self._streams.serve(listening.address[1], self._serve)

    async def _serve(self, reader: Any, writer: Any) -> None:
        with contextlib.suppress(ReplicationError):
            await self._server.serve(reader, writer)


@contextlib.contextmanager
def joined(network: Network, streams: Streams, random: Random) -> Iterator[None]:
    async def exchange(client: Any, request: bytes, seconds: float) -> bytes:
        body = request.partition(b"\r\n\r\n")[2]
        source = present_process().machine.name
        return await network.exchange((client.uri.host, client.uri.port), body, seconds, source)

    def listen(host: str, port: int) -> Socket:
        return Socket(host, port or network.free_port())

    files, databases = disk.files()

    async def follow_at(address: str, port: int, _context: object, receiver: ReplicationReceiver) -> None:
        try:
            end = await streams.connect(address, port)
        except OSError as error:
            raise ReplicationError(str(error)) from error
        await receiver.follow(end.reader, end)  # type: ignore[arg-type]  # it has what the link uses

    datagrams = SimpleNamespace(socket=streams.socket, AF_INET=0, SOCK_DGRAM=0)
    sockets = SimpleNamespace(socket=_handle)
    replaced: list[tuple[Any, str, Any]] = [
        (secrets, "_sysrand", random),
        (rosmaster, "uuid", SimpleNamespace(uuid1=lambda: "run")),
        (control, "StateStore", partial(StateStore, kind=disk.WorldDatabase)),
        (control, "AuditLog", partial(AuditLog, drive=disk.EngineSteps)),
        (changes, "os", files),
        (log_writer, "os", files),
        (writer_thread, "sqlite3", databases),
        (log_database, "sqlite3", databases),
        (XmlRpcClient, "_exchange", exchange),
        (listener_limits, "HttpServer", partial(_Server, network)),
        (control, "listen", listen),
        (listener_limits, "listen", listen),
        (process, "AdminServer", _AdminServer),
        (passive, "AdminServer", _AdminServer),
        (process, "Control", _make_control),
        (process, "return_spare_memory", _forever),
        (supervisor_link, "os", SimpleNamespace(close=_handle)),
        (child_process, "os", SimpleNamespace(close=_handle)),
        (supervisor_link, "socket", sockets),
        (supervisor_link, "Channel", _handle),
        (lease_process, "socket", datagrams),
        (lease_process, "Channel", _handle),
        (child_process, "socket", sockets),
        (child_process, "Channel", _handle),
        (replica, "sqlite3", databases),
        (passive, "follow_at", follow_at),
        (passive, "replication_context", _handle),
        (passive, "ReplicationListener", partial(_Listener, streams)),
        (passive, "socket", SimpleNamespace(create_server=_listening, socket=_handle)),
        (passive, "replication_context", _handle),
        (replication, "replication_context", _handle),
        (replication, "ReplicationListener", partial(_Listener, streams)),
        (replication, "socket", SimpleNamespace(create_server=_listening)),
        (process, "socket", sockets),
        (process, "Channel", _handle),
    ]
    before = [(place, name, getattr(place, name)) for place, name, _other in replaced]
    try:
        for place, name, other in replaced:
            setattr(place, name, other)
        yield
    finally:
        for place, name, value in before:
            setattr(place, name, value)
