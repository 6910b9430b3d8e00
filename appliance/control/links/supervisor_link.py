"""Exchange messages with the supervisor over control's lifeline."""

import asyncio
import contextlib
import ipaddress
import itertools
import os
import socket
from collections.abc import Awaitable, Callable, Mapping

import msgspec
import structlog

from appliance.base import clock
from appliance.base.timestamps import parse_date
from appliance.channel import messages
from appliance.channel.answers.status import FirewallState, ProcessInfo
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages.api import ApiLink
from appliance.policy.model import Address

ROUTES_AT_ONCE = 32  # the most open route queries; unknown hosts cause them, and the supervisor limits them

Heard = Callable[[object, tuple[int, ...]], None]
"""A handler of the supervisor's messages and their descriptors."""

Enclosed = Callable[[messages.TunnelsEnclosed], object]
"""A handler of the supervisor's answer to `TunnelsWanted`."""

_log = structlog.get_logger()


class MachineWorkFailedError(Exception):
    """The supervisor could not do the work; the message gives the reason."""


class Surroundings:
    """The last reports of the supervisor.

    `probe` is empty before the first probe; then it is `passed` or the reason of the failure.
    """

    def __init__(self) -> None:
        self._processes: list[tuple[ProcessInfo, clock.Began]] = []
        self.firewall = messages.FirewallReported("unknown", FirewallState())
        self.machine: tuple[Address, ...] = ()  # addresses of the robot's machine
        self.probe = ""
        self.master = ""
        self.after_removal: list[Callable[[], None]] = []
        """Called when rules of the firewall are in force again that another program had removed."""

    @property
    def processes(self) -> list[ProcessInfo]:
        """The last report, with the dates by the present system clock."""
        return [msgspec.structs.replace(row, since=since.text()) for row, since in self._processes]

    @processes.setter
    def processes(self, rows: list[ProcessInfo]) -> None:
        self._processes = [(row, clock.Began(parse_date(row.since) / 1e9)) for row in rows]


class SupervisorQuestions:
    """Questions to the supervisor, each until its answer."""

    def __init__(self, say: Callable[[messages.Message], None]) -> None:
        self._say = say
        self._routes: dict[str, list[asyncio.Future[str | None]]] = {}
        self._free_routes = asyncio.Semaphore(ROUTES_AT_ONCE)
        self._endpoints: list[asyncio.Future[messages.EndpointFound]] = []
        self._own_networks: list[asyncio.Future[str]] = []
        self._machine_work: dict[int, asyncio.Future[messages.MachineWorkDone]] = {}
        self._numbers = itertools.count(1)

    async def route_to(self, host: str) -> str | None:
        """Return the machine's address at which `host` reaches the appliance, or None if `host` already used it."""
        if host not in self._routes:
            await self._free_routes.acquire()
            if host in self._routes:  # another call has sent the query in the meantime
                self._free_routes.release()
            else:
                self._routes[host] = []
                self._say(messages.RouteWanted(host))
        future: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
        self._routes[host].append(future)
        return await future

    async def endpoint(self) -> messages.EndpointFound:
        future: asyncio.Future[messages.EndpointFound] = asyncio.get_running_loop().create_future()
        self._endpoints.append(future)
        self._say(messages.EndpointWanted())
        return await future

    async def open_own_network(self, network: str, ports: list[int]) -> str:
        future: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._own_networks.append(future)
        self._say(messages.OwnNetworkWanted(network, ports))
        return await future

    async def machine_work(self, feature: str, work: str, **terms: object) -> dict[str, object]:
        """Have the supervisor do a piece of a feature's work. Raises `MachineWorkFailedError` with its reason."""
        number = next(self._numbers)
        done: asyncio.Future[messages.MachineWorkDone] = asyncio.get_running_loop().create_future()
        self._machine_work[number] = done
        self._say(messages.MachineWorkWanted(number, feature, work, terms))
        try:
            answer = await done
        finally:
            self._machine_work.pop(number, None)
        if answer.reason:
            raise MachineWorkFailedError(answer.reason)
        return answer.found

    def take_answer(self, message: object) -> bool:
        """Give an answer to those who wait for it; return False for a message that answers no question."""
        match message:
            case messages.MachineWorkDone(number):
                if (asked := self._machine_work.get(number)) is not None and not asked.done():
                    asked.set_result(message)
            case messages.OwnNetworkOpened(reason):
                if self._own_networks and not (waiter := self._own_networks.pop(0)).done():
                    waiter.set_result(reason)
            case messages.EndpointFound():
                asked_for, self._endpoints = self._endpoints, []
                for endpoint in asked_for:
                    if not endpoint.done():
                        endpoint.set_result(message)
            case messages.RouteFound(host, address):
                futures = self._routes.pop(host, None)
                if futures is not None:
                    self._free_routes.release()
                for future in futures or ():
                    if not future.done():
                        future.set_result(address)
            case _:
                return False
        return True


class ControlLifeline:
    """Control's end of the lifeline.

    `links` has a function for each process for which the start of control may wait, with the messages accepted from
    it. Other messages are queued until `hear` is called.
    """

    def __init__(
        self,
        descriptor: int,
        stopping: asyncio.Event,
        links: Mapping[str, tuple[Callable[[Channel], None], object]],
    ) -> None:
        self._stopping = stopping
        self._enclosed: Enclosed = lambda _answer: None  # before tunnels are wanted
        self._links = links
        self.activated = asyncio.Event()
        self.epoch: int | None = None
        self.channel = Channel(socket.socket(fileno=descriptor), messages.Lifeline)
        self.surroundings = Surroundings()
        self.sockets: dict[str, socket.socket] = {}
        self.restored = asyncio.Event()
        # Whether the caller that started the appliance has received `Ready` from an earlier control process.
        self.announced = False
        self.questions = SupervisorQuestions(self.say)
        self._before_end: list[Callable[[], Awaitable[None]]] = []
        self._early: dict[tuple[object, ...], tuple[object, tuple[int, ...]]] = {}
        self._heard: Heard = self.queue

    def attach(self) -> None:
        self.channel.attach(asyncio.get_running_loop(), self._on_message, self._on_close)

    def hear(self, heard: Heard) -> None:
        early, self._early, self._heard = self._early, {}, heard
        for said in early.values():
            heard(*said)

    def hear_tunnels(self, enclosed: Enclosed) -> None:
        self._enclosed = enclosed

    def before_end(self, work: Callable[[], Awaitable[None]]) -> None:
        self._before_end.append(work)

    def after_removal(self, work: Callable[[], None]) -> None:
        self.surroundings.after_removal.append(work)

    async def finish(self) -> None:
        """Finish the work of features before an ordered end."""
        for work in self._before_end:
            await work()

    def pause(self) -> None:
        self._heard = self.queue

    def queue(self, message: object, descriptors: tuple[int, ...]) -> None:
        """Queue a message in place of an earlier one of its kind, because control may wait for months."""
        key: tuple[object, ...] = (type(message),)
        if isinstance(message, messages.LinkOpened | messages.ProcessDied):
            key = (*key, message.role, message.index)
        _message, replaced = self._early.pop(key, (None, ()))
        for descriptor in replaced:
            os.close(descriptor)
        self._early[key] = (message, descriptors)

    def api_channel(self, descriptor: int) -> Channel:
        return Channel(socket.socket(fileno=descriptor), ApiLink, limit=16 << 20, longest=8 << 20)

    def say(self, message: messages.Message) -> None:
        self._send(message, ())

    def log_held(self) -> Callable[[list[int]], None]:
        loop = asyncio.get_running_loop()

        def report(processes: list[int]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self.say, messages.LogHeld(processes))

        return report

    def keep(self, name: str, sock: socket.socket) -> None:
        self._send(messages.SocketKept(name), (sock.fileno(),))

    def drop(self, name: str) -> None:
        self.say(messages.SocketDropped(name))

    def _send(self, message: messages.Message, descriptors: tuple[int, ...]) -> None:
        try:
            self.channel.send(message, descriptors)
        except ChannelClosedError:
            self._on_close()

    def _on_close(self) -> None:
        _log.warning("the link to the supervisor is closed")
        self._stopping.set()

    def _on_message(self, message: object, descriptors: tuple[int, ...]) -> None:
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
            case messages.LinkOpened(role) if role in self._links:
                attach, accepted = self._links[role]
                attach(Channel(socket.socket(fileno=descriptors[0]), accepted))
            case messages.Activated(epoch):
                self.epoch = epoch
                self.activated.set()
            case messages.FirewallReported():
                self.surroundings.firewall = message
            case messages.TunnelsEnclosed():
                self._enclosed(message)
            case _ if self.questions.take_answer(message):
                pass
            case _:
                self._note(message)
                self._heard(message, descriptors)

    def _note(self, message: object) -> None:
        match message:
            case messages.MachineAddresses(addresses):
                self.surroundings.machine = tuple(map(ipaddress.ip_address, addresses))
            case messages.ProcessesChanged(processes):
                self.surroundings.processes = processes
            case messages.ProbeFailed(reason):
                self.surroundings.probe = reason
            case messages.ProbePassed():
                self.surroundings.probe = "passed"
