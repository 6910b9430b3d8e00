"""The simulated network: HTTP exchanges between hosts, and links between the processes of one machine.

Each message takes a random time. If the network is cut, a request or its answer is lost, and the caller waits until
its time limit. A killed process refuses connections, and breaks those that it served.
"""

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any

from appliance.channel import messages
from appliance.rpc.server import Peer
from appliance.rpc.xmlrpc_client import UnreachedError
from tests.world.loop import Process, WorldLoop, present_process

Address = tuple[str, int]
Answer = Callable[[Peer, bytes], Awaitable[bytes]]
LOST = (OSError, TimeoutError, UnreachedError)
"""The errors of an exchange whose outcome the caller does not know."""
_SECONDS = (0.0, 0.0, 0.001, 0.01, 0.1)
_LINK_SECONDS = (0.0, 0.0, 0.0, 0.001, 0.02)
_FLAKY = 0.03
_IN_ORDER = 1e-7  # seconds between two messages of a link, because timers of the same time have no order


@dataclass(eq=False)
class _Served:
    process: Process
    answer: Answer


class Network:
    def __init__(self, loop: WorldLoop) -> None:
        self.loop = loop
        self._random: Random = loop.random
        self._servers: dict[Address, _Served] = {}
        self.cut: set[frozenset[str]] = set()
        self.route: Callable[[Address], Address | None] = lambda address: (
            address
        )  # a translation of addresses
        self._port = 50_000
        self.flaky: Address | None = None  # a server whose connections break off now and then
        self._open: dict[asyncio.Future[bytes], Process] = {}

    def reaches(self, source: str, target: str) -> bool:
        return frozenset((source, target)) not in self.cut

    def free_port(self) -> int:
        self._port += 1
        return self._port

    def serve(self, address: Address, answer: Answer) -> None:
        process = present_process()
        self._servers[address] = _Served(process, answer)

    def stop(self, address: Address) -> None:
        self._servers.pop(address, None)

    def broken(self, process: Process) -> None:
        for future, server in list(self._open.items()):
            if server is process:
                del self._open[future]
                self._later(self._fail, future, ConnectionResetError("the connection ended"))

    async def exchange(self, address: Address, body: bytes, seconds: float, source: str) -> bytes:
        future: asyncio.Future[bytes] = self.loop.create_future()
        self._later(self._arrive, address, body, source, future)
        try:
            async with asyncio.timeout(seconds):
                return await future
        except TimeoutError:
            if not self.reaches(source, address[0]):
                raise UnreachedError(f"{address[0]} cannot be reached") from None
            raise
        finally:
            self._open.pop(future, None)

    def _arrive(self, address: Address, body: bytes, source: str, future: asyncio.Future[bytes]) -> None:
        there = self.route(address)
        if there is None or not self.reaches(source, there[0]):
            return
        address = there
        served = self._servers.get(address)
        if served is None or not served.process.alive or self._breaks(address):
            self._later(self._fail, future, ConnectionRefusedError(111, "Connection refused"))
            return
        self._open[future] = served.process
        peer = Peer(ipaddress.ip_address(source), source, address[0])
        served.process.start(self._serve(served.answer, peer, body, future))
        if self._breaks(address):  # it carries the request out, and the answer is lost
            self._later(self._fail, future, ConnectionResetError("the connection ended"))

    def _breaks(self, address: Address) -> bool:
        return address == self.flaky and self._random.random() < _FLAKY

    async def _serve(self, answer: Answer, peer: Peer, body: bytes, future: asyncio.Future[bytes]) -> None:
        try:
            given = await answer(peer, body)
        except ConnectionError as error:
            self._later(self._fail, future, error)
            return
        if self.reaches(peer.local, peer.text):
            self._later(self._finish, future, given)

    def _finish(self, future: asyncio.Future[bytes], given: bytes) -> None:
        if not future.done():
            future.set_result(given)

    def _fail(self, future: asyncio.Future[bytes], error: Exception) -> None:
        if not future.done():
            future.set_exception(error)

    def _later(self, act: Callable[..., None], *given: Any) -> None:
        self.loop.outside.call(self._random.choice(_SECONDS), act, *given)


@dataclass(eq=False)
class LinkEnd:
    process: Process
    other: "LinkEnd" = field(init=False)
    closed: bool = False
    crowded: bool = False  # its other end always reads
    last: float = 0.0
    _waiting: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)
    _received: Callable[[Any, tuple[Any, ...]], None] | None = None
    _ended: Callable[[], None] | None = None

    @classmethod
    def pair(cls, one: Process, two: Process) -> "tuple[LinkEnd, LinkEnd]":
        ends = cls(one), cls(two)
        ends[0].other, ends[1].other = ends[1], ends[0]
        for end in ends:
            end.process.ends.append(end.killed)
        return ends

    def attach(
        self,
        _loop: object,
        received: Callable[[Any, tuple[Any, ...]], None],
        closed: Callable[[], None],
        _invalid: Callable[[str], None] | None = None,
    ) -> None:
        self._received, self._ended = received, closed
        waiting, self._waiting = self._waiting, []
        for message, descriptors in waiting:
            self.process.call(0.0, self.take, message, descriptors)
        if self.other.closed:
            self.process.call(0.0, closed)

    def send(
        self, message: messages.Message, descriptors: tuple[Any, ...] = (), *, soon: bool = False
    ) -> None:
        """Send a message. A `soon` one may take longer, but overtakes none."""
        del soon
        if not self.closed:
            self._carry(self.other.take, message, descriptors)

    def _carry(self, act: Callable[..., None], *given: Any) -> None:
        loop = self.process.machine.loop
        self.last = max(self.last + _IN_ORDER, loop.present + loop.random.choice(_LINK_SECONDS))
        loop.at(self.last, act, given, self.other.process.context.copy())

    def take(self, message: Any, descriptors: tuple[Any, ...]) -> None:
        if self.closed:
            return
        if self._received is None:
            self._waiting.append((message, descriptors))
        else:
            self._received(message, descriptors)

    def end(self) -> None:
        if not self.closed and self._ended is not None:
            self._ended()

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._carry(self.other.end)

    killed = close

    def fileno(self) -> "LinkEnd":
        return self

    detach = fileno
