"""Control's end of its lifeline: what the supervisor tells it, and what it asks of the supervisor."""

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import structlog

from appliance.channel import messages
from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.channel import Channel, ChannelClosedError

ROUTES_AT_ONCE = 32  # strangers make control ask, and the supervisor takes only so many questions

Heard = Callable[[Any, tuple[int, ...]], None]
"""Is given a message of the supervisor and the descriptors that came with it."""

_log = structlog.get_logger()


class Surroundings:
    """What the supervisor told control last; `probe` is empty before the first, then `passed` or the reason.

    `master` is where nodes find their master, as they are told; empty before control is ready.
    """

    def __init__(self) -> None:
        self.processes: list[ProcessInfo] = []
        self.firewall = messages.FirewallReported("unknown", FirewallState())
        self.probe = ""
        self.master = ""


class ControlLifeline:
    """The lifeline. `stopping` is set at the end, `enclosed(answer)` hears whether tunnels are open. A start may wait
    for the compiler: `compiler(channel)` is given each link to it at once.

    What else is for other parts of control is handed to them, in order, from `hear` on.
    """

    def __init__(
        self,
        descriptor: int,
        stopping: asyncio.Event,
        enclosed: Callable[[messages.TunnelsEnclosed], None],
        compiler: Callable[[Channel], None],
    ) -> None:
        self._stopping = stopping
        self._enclosed = enclosed
        self._compiler = compiler
        self.channel = Channel(socket.socket(fileno=descriptor), messages.Lifeline)
        self.surroundings = Surroundings()
        self.sockets: dict[str, socket.socket] = {}
        self.restored = asyncio.Event()
        # Whether whoever started the appliance knew what `Ready` said before this life
        self.announced = False
        self._routes: dict[str, list[asyncio.Future[str | None]]] = {}  # what is asked and not answered
        self._free_questions = asyncio.Semaphore(ROUTES_AT_ONCE)
        self._endpoints: list[asyncio.Future[messages.EndpointFound]] = []
        self._early: list[tuple[Any, tuple[int, ...]]] = []
        self._heard: Heard = lambda *said: self._early.append(said)

    def attach(self) -> None:
        """Begin to listen; `restored` is set when all kept sockets are here."""
        self.channel.attach(asyncio.get_running_loop(), self._received, self._closed)

    def hear(self, heard: Heard) -> None:
        """Hand out what came before control was ready for it, and from now on what comes."""
        early, self._early, self._heard = self._early, [], heard
        for said in early:
            heard(*said)

    def say(self, message: messages.Message) -> None:
        """Tell the supervisor something."""
        self._send(message, ())

    def keep(self, name: str, sock: socket.socket) -> None:
        """Have the supervisor keep a listening socket over our death."""
        self._send(messages.SocketKept(name), (sock.fileno(),))

    def drop(self, name: str) -> None:
        """A kept socket is needed no longer."""
        self.say(messages.SocketDropped(name))

    async def route_to(self, host: str) -> str | None:
        """The machine's address that `host` reaches the appliance at; None: the one it used.

        Asked once for all who wait for the same host, and for `ROUTES_AT_ONCE` hosts at once; others wait.
        """
        if host not in self._routes:
            await self._free_questions.acquire()
            if host in self._routes:  # somebody else has asked meanwhile
                self._free_questions.release()
            else:
                self._routes[host] = []
                self.say(messages.RouteWanted(host))
        future: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
        self._routes[host].append(future)
        return await future

    async def endpoint(self) -> messages.EndpointFound:
        """Where hosts of other networks reach the appliance, as the supervisor sees it now."""
        future: asyncio.Future[messages.EndpointFound] = asyncio.get_running_loop().create_future()
        self._endpoints.append(future)
        self.say(messages.EndpointWanted())
        return await future

    def _send(self, message: messages.Message, descriptors: tuple[int, ...]) -> None:
        try:
            self.channel.send(message, descriptors)
        except ChannelClosedError:
            self._closed()

    def _closed(self) -> None:
        _log.warning("the supervisor is gone")
        self._stopping.set()

    def _received(self, message: Any, descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.Ping(number):
                self.say(messages.Pong(number))
            case messages.Stop():
                self._stopping.set()
            case messages.SocketRestored(name):
                self.sockets[name] = socket.socket(fileno=descriptors[0])
            case messages.SocketsRestored(_count, announced):
                self.announced = announced
                self.restored.set()
            case messages.LinkOpened(role="compiler"):
                self._compiler(Channel(socket.socket(fileno=descriptors[0]), messages.CompilerLink))
            case messages.FirewallReported():
                self.surroundings.firewall = message
            case messages.TunnelsEnclosed() | messages.EndpointFound() | messages.RouteFound():
                self._answered(message)
            case _:
                self._note(message)
                self._heard(message, descriptors)

    def _note(self, message: Any) -> None:
        match message:
            case messages.ProcessesChanged(processes):
                self.surroundings.processes = processes
            case messages.ProbeFailed(reason):
                self.surroundings.probe = reason
            case messages.ProbePassed():
                self.surroundings.probe = "passed"

    def _answered(
        self, message: messages.TunnelsEnclosed | messages.EndpointFound | messages.RouteFound
    ) -> None:
        """What control has asked for."""
        match message:
            case messages.TunnelsEnclosed():
                self._enclosed(message)
            case messages.EndpointFound():
                waiting, self._endpoints = self._endpoints, []
                for waiter in waiting:
                    if not waiter.done():
                        waiter.set_result(message)
            case messages.RouteFound(host, address):
                futures = self._routes.pop(host, None)
                if futures is not None:
                    self._free_questions.release()
                for future in futures or ():
                    if not future.done():
                        future.set_result(address)
