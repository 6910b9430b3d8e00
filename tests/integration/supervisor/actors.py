"""Small processes that follow the protocol of the real ones, to test the supervisor alone.

Each prints its messages as JSON. The actor for control answers each connection with its process id.
"""

import asyncio
import json
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    ApplianceStopRequested,
    Failed,
    Lifeline,
    LinkOpened,
    Message,
    Ping,
    Pong,
    ProcessDied,
    ProcessesChanged,
    Ready,
    RelayLink,
    SignerLink,
    SocketKept,
    SocketRestored,
    SocketsRestored,
    StateBegan,
    Stop,
)
from appliance.configuration.settings import load_resolved

ECHO = "echo"
CROWD = 2_000  # two for each node of a robot with a thousand


def control(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Control(lifeline_fd, load_resolved(config).rosmaster_port).run())


def relay(lifeline_fd: int, index: int, config: Path) -> None:
    asyncio.run(_Actor("relay", lifeline_fd, RelayLink).run())


def crowded(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Crowded(lifeline_fd, load_resolved(config).rosmaster_port).run())


def signer(lifeline_fd: int, directory: Path, passphrase: int | None) -> None:
    asyncio.run(_Actor("signer", lifeline_fd, SignerLink).run())


def stubborn(lifeline_fd: int, index: int, config: Path) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    asyncio.run(_Stubborn("relay", lifeline_fd, RelayLink).run())


def failing(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Failing("control", lifeline_fd, RelayLink).run())


def failing_again(lifeline_fd: int, config: Path) -> None:
    lives = config.parent.parent / "control" / "lives"
    with lives.open("a") as file:
        file.write(".")
    if 1 < lives.stat().st_size < 5:
        asyncio.run(_Failing("control", lifeline_fd, RelayLink).run())
    else:
        control(lifeline_fd, config)


def dying(lifeline_fd: int, config: Path) -> None:
    sys.exit(3)


class _Actor:
    def __init__(self, name: str, lifeline_fd: int, union: Any) -> None:
        self.name = name
        self.union = union
        self.lifeline = Channel(socket.socket(fileno=lifeline_fd), Lifeline)
        self.links: dict[str, Channel] = {}
        self.ended = asyncio.Event()

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGUSR1, self.misbehave)
        self.lifeline.attach(loop, self.received, self.ended.set)
        self.started()
        await self.ended.wait()

    def started(self) -> None:
        self.lifeline.send(Ready())

    def misbehave(self) -> None:
        one, other = socket.socketpair()
        with one, other:
            self.lifeline.send(SocketKept("stolen"), (one.fileno(),))

    def say(self, **fields: Any) -> None:
        os.write(2, (json.dumps({"actor": self.name, "pid": os.getpid(), **fields}) + "\n").encode())

    def received(self, message: Message, descriptors: tuple[int, ...]) -> None:
        match message:
            case Ping(number):
                self.lifeline.send(Pong(number))
            case Stop():
                self.ended.set()
            case LinkOpened(role, index):
                self.open_link(role, index, descriptors[0])

    def open_link(self, role: str, index: int, descriptor: int) -> None:
        union = _union_of(role) if self.name == "control" else self.union
        link = Channel(socket.socket(fileno=descriptor), union)
        if role in self.links:
            self.links[role].close()
        self.links[role] = link
        link.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: self.say(link=role, index=index, said=type(message).__name__),
            lambda: None,
        )
        if role == "relay":
            link.send(StateBegan(os.getpid()))


class _Stubborn(_Actor):
    def received(self, message: Message, descriptors: tuple[int, ...]) -> None:
        if not isinstance(message, Stop):
            super().received(message, descriptors)


class _Failing(_Actor):
    def started(self) -> None:
        self.lifeline.send(Failed("policy.ini:3: unknown section [Nods]\npolicy.ini:9: unknown key \x1b[2J"))


class _Control(_Actor):
    def __init__(self, lifeline_fd: int, rosmaster_port: int) -> None:
        super().__init__("control", lifeline_fd, None)
        self.rosmaster_port = rosmaster_port
        self.sockets: dict[str, socket.socket] = {}

    def started(self) -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGUSR2, self.ask_for_the_end)

    def misbehave(self) -> None:
        self.lifeline.send(SocketsRestored(1))

    def ask_for_the_end(self) -> None:
        self.lifeline.send(ApplianceStopRequested("shutdown by /rosnode"))

    def received(self, message: Message, descriptors: tuple[int, ...]) -> None:
        match message:
            case SocketRestored(name):
                self.sockets[name] = socket.socket(fileno=descriptors[0])
            case SocketsRestored(count):
                self.say(restored=sorted(self.sockets), count=count)
                self.serve()
            case ProcessesChanged(processes):
                self.say(processes={process.role: [process.pid, process.restarts] for process in processes})
            case ProcessDied(role, _index, pid, end):
                self.say(died=role, died_pid=pid, end=end)
            case _:
                super().received(message, descriptors)

    def serve(self) -> None:
        if ECHO not in self.sockets:
            self.sockets[ECHO] = socket.create_server(("127.0.0.1", 0))
            self.lifeline.send(SocketKept(ECHO), (self.sockets[ECHO].fileno(),))
        listener = self.sockets[ECHO]
        listener.setblocking(False)
        asyncio.get_running_loop().add_reader(listener.fileno(), self.answer, listener)
        port = listener.getsockname()[1]
        detail = {
            "master": f"http://127.0.0.1:{port}",
            "revision": 1,
            # Here rosout talks to rosmaster directly.
            "rosout_master": f"http://127.0.0.1:{self.rosmaster_port}",
            "inner_port": 1,
            "own_port": 2,
        }
        self.lifeline.send(Ready(detail))

    def answer(self, listener: socket.socket) -> None:
        connection, _address = listener.accept()
        with connection:
            connection.sendall(str(os.getpid()).encode())


class _Crowded(_Control):
    def serve(self) -> None:
        for number in range(CROWD if ECHO not in self.sockets else 0):
            with socket.create_server(("127.0.0.1", 0)) as listener:
                self.lifeline.send(SocketKept(f"port:{number}"), (listener.fileno(),))
        super().serve()


def _union_of(role: str) -> Any:
    return RelayLink if role == "relay" else SignerLink
