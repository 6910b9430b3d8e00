"""Control's end of its lifeline: what the supervisor tells it, and what it asks of the supervisor."""

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import structlog

from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.control.surroundings import Surroundings

ROUTES_AT_ONCE = 32  # strangers make control ask, and the supervisor takes only so many questions

_log = structlog.get_logger()


class ControlLifeline:
    """The lifeline; `links[role]` is called with the other end's index and each new link, `stopped()` at the end."""

    def __init__(self, descriptor: int) -> None:
        self._channel = Channel(socket.socket(fileno=descriptor), messages.Lifeline)
        self.surroundings = Surroundings()
        self.sockets: dict[str, socket.socket] = {}
        self.restored = asyncio.Event()
        self.announced = False  # whether whoever started the appliance knows what `Ready` said
        self.was_announced: Callable[[], None] = lambda: None
        self.links: dict[str, Callable[[int, int], None]] = {}
        self.stopped: Callable[[], None] = lambda: None
        self.processes_changed: Callable[[], None] = lambda: None
        self.reload_requested: Callable[[], None] = lambda: None
        self.probed: Callable[[str], None] = lambda reason: None  # noqa: ARG005 - set by control
        self.tunnels_enclosed: Callable[[messages.TunnelsEnclosed], None] = lambda answer: None  # noqa: ARG005 - as above
        self._routes: dict[str, list[asyncio.Future[str | None]]] = {}  # what is asked and not answered
        self._free_questions = asyncio.Semaphore(ROUTES_AT_ONCE)
        self._endpoints: list[asyncio.Future[messages.EndpointFound]] = []
        self._early_links: list[tuple[str, int, int]] = []

    def attach(self) -> None:
        """Begin to listen; `restored` is set when all kept sockets are here."""
        self._channel.attach(asyncio.get_running_loop(), self._received, self._closed)

    def open_links(self) -> None:
        """Hand out the links that came before control was ready for them."""
        early, self._early_links = self._early_links, []
        for role, index, descriptor in early:
            self._open_link(role, index, descriptor)

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
            self._channel.send(message, descriptors)
        except ChannelClosedError:
            self._closed()

    def _closed(self) -> None:
        _log.warning("the supervisor is gone")
        self.stopped()

    def _received(self, message: Any, descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.Ping(number):
                self.say(messages.Pong(number))
            case messages.Stop():
                self.stopped()
            case messages.SocketRestored(name):
                self.sockets[name] = socket.socket(fileno=descriptors[0])
            case messages.SocketsRestored(_count, announced):
                self.announced = announced
                self.restored.set()
            case messages.LinkOpened(role, index):
                self._open_link(role, index, descriptors[0])
            case _ if not descriptors:
                self._learned(message)
            case _:
                _not_for_us(message)

    def _learned(self, message: Any) -> None:
        """What only changes what control knows of its surroundings, or asks it to do something."""
        match message:
            case messages.ProcessesChanged(processes):
                self.surroundings.processes = processes
                self.processes_changed()
            case messages.PolicyReloadRequested():
                self.reload_requested()
            case messages.Announced():
                self.announced = True
                self.was_announced()
            case messages.FirewallReported():
                self.surroundings.firewall = message
            case messages.ProbeFailed(reason):
                self.surroundings.probe = reason
                self.probed(reason)
            case messages.ProbePassed():
                self.surroundings.probe = "passed"
                self.probed("")
            case _:
                self._answered(message)

    def _answered(self, message: Any) -> None:
        """What control has asked for."""
        match message:
            case messages.TunnelsEnclosed():
                self.tunnels_enclosed(message)
            case messages.EndpointFound():
                waiting, self._endpoints = self._endpoints, []
                for one in waiting:
                    if not one.done():
                        one.set_result(message)
            case messages.RouteFound(host, address):
                futures = self._routes.pop(host, None)
                if futures is not None:
                    self._free_questions.release()
                for future in futures or ():
                    if not future.done():
                        future.set_result(address)
            case _:
                _not_for_us(message)

    def _open_link(self, role: str, index: int, descriptor: int) -> None:
        serve = self.links.get(role)
        if serve is not None:
            serve(index, descriptor)
        else:
            self._early_links.append((role, index, descriptor))


def _not_for_us(message: Any) -> None:
    _log.error("the supervisor said something that is not for control", message=type(message).__name__)
