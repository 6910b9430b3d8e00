"""Play control for a real relay process: a master for real ROS nodes, in front of a real rosmaster.

Every node that registers gets a proxy endpoint and a relay port. It makes no decisions and protects nothing. As a
program it serves until its standard input ends, for measurements:

    python3 -m tests.support.relay_driver --master-port 11611 --rosmaster-port 11612
"""

import argparse
import contextlib
import itertools
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path
from socketserver import ThreadingMixIn
from types import TracebackType
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import (
    ClientGranted,
    FactWithdrawn,
    GrantInstalled,
    Lifeline,
    LinkOpened,
    Message,
    NodePlaced,
    Ping,
    Pong,
    PublicationPlaced,
    Ready,
    RelayLink,
    ServicePlaced,
    StateBegan,
    StateEnded,
    Stop,
    UpstreamFound,
    UpstreamRefused,
    UpstreamWanted,
)
from tests.support.processes import LIMIT
from tests.support.waiting import eventually

LOOPBACK = "127.0.0.1"
_URI = re.compile(r"^\w+://([^:/]+):(\d+)")


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    allow_reuse_address = True


class _Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ()
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True


class ChannelPeer:
    def __init__(
        self, sock: socket.socket, union: Any, received: Callable[[Any], None] | None = None
    ) -> None:
        self._channel = Channel(sock, union)
        self._received = received
        self._changed = threading.Condition()
        self._lock = threading.Lock()
        self.messages: list[Any] = []
        self.ended = threading.Event()
        self._closed = False
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def send(self, message: Message, descriptors: tuple[int, ...] = ()) -> None:
        with self._lock:
            self._channel.send(message, descriptors)
        self._wake.send(b"x")

    def send_bytes(self, data: bytes) -> None:
        os.write(self._channel.fileno(), data)

    def wait_for(self, wanted: Callable[[Any], bool], seconds: float = 20.0, after: int = 0) -> Any:
        deadline = time.monotonic() + seconds
        with self._changed:
            while True:
                for message in self.messages[after:]:
                    if wanted(message):
                        return message
                left = deadline - time.monotonic()
                if left <= 0:
                    raise AssertionError(
                        f"no such message within {seconds} s; there were {self.messages[-20:]}"
                    )
                self._changed.wait(left)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self.ended.set()
        self._wake.send(b"x")
        self._thread.join(5)
        self._wake.close()
        self._woken.close()

    def _serve(self) -> None:
        while not self.ended.is_set():
            writing = [self._channel.fileno()] if self._channel.pending else []
            select.select([self._channel.fileno(), self._woken.fileno()], writing, [])
            if self.ended.is_set():
                break
            if select.select([self._woken], [], [], 0)[0]:
                self._woken.recv(4096)
            try:
                with self._lock:
                    self._channel.flush()
                    messages = self._channel.receive()
            except ChannelClosedError:
                break
            for message, _descriptors in messages:
                if self._received is not None:
                    self._received(message)
                with self._changed:
                    self.messages.append(message)
                    self._changed.notify_all()
        self.ended.set()
        with self._changed:
            self._changed.notify_all()
        with self._lock:
            self._channel.close()


class RelayProcess:
    def __init__(self, limits: str = "None") -> None:
        ours, theirs = socket.socketpair()
        code = (
            "import sys; from appliance.relay.process import main;"
            f" from appliance.relay.relay_limits import RelayLimits; main(int(sys.argv[1]), 0, {limits})"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            cwd=Path(__file__).parents[2],
        )
        theirs.close()
        self.lifeline = ChannelPeer(ours, Lifeline)
        self.ready: Ready = self.lifeline.wait_for(lambda message: isinstance(message, Ready))

    def open_link(self, received: Callable[[Any], None] | None = None) -> ChannelPeer:
        ours, theirs = socket.socketpair()
        link = ChannelPeer(ours, RelayLink, received)
        self.lifeline.send(LinkOpened("control", 0), (theirs.fileno(),))
        theirs.close()
        return link

    def ping(self, number: int) -> None:
        """Wait for two turns of the relay's main loop: in the first it may accept a link without reading it."""
        for answer in (Pong(number), Pong(number + 1_000_000)):
            after = len(self.lifeline.messages)
            self.lifeline.send(Ping(answer.number))
            self.lifeline.wait_for(answer.__eq__, after=after)

    def stop(self) -> int:
        if self.process.poll() is None:
            self.lifeline.send(Stop())
        status = self.process.wait(LIMIT)
        self.lifeline.close()
        return status

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(LIMIT)
        self.lifeline.close()


class Face:
    def __init__(self, driver: "RelayDriver", name: str, uri: str) -> None:
        self.driver = driver
        self.name = name
        self.real_uri = uri
        self.key = f"{name}-{next(driver.numbers)}"
        self.publications: dict[str, str] = {}
        self.services: dict[str, int] = {}
        self.grants: set[tuple[str, str]] = set()
        self.clients: set[tuple[str, str]] = set()
        self.listening = socket.create_server((LOOPBACK, 0), backlog=128)
        self.port: int = self.listening.getsockname()[1]
        self._server = _Server((LOOPBACK, 0), _Handler, logRequests=False, allow_none=True)
        self._server.register_instance(self)
        self.uri = f"http://{LOOPBACK}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _dispatch(self, method: str, parameters: tuple[Any, ...]) -> Any:
        if method == "requestTopic":
            caller_id, topic, _protocols = parameters
            if topic not in self.publications:
                return [0, f"not a publisher of {topic}", 0]
            if self.driver.granting:
                self.grants.add((topic, caller_id))
                self.driver.link.send(GrantInstalled(self.key, topic, LOOPBACK, caller_id))
            return [1, "ready", ["TCPROS", LOOPBACK, self.port]]
        return call(self.real_uri, method, *parameters)

    def statements(self) -> list[tuple[Message, tuple[int, ...]]]:
        return [
            (NodePlaced(self.key, self.name, LOOPBACK), (self.listening.fileno(),)),
            *((PublicationPlaced(self.key, topic, kind), ()) for topic, kind in self.publications.items()),
            *((ServicePlaced(self.key, name, LOOPBACK, port), ()) for name, port in self.services.items()),
            *((ClientGranted(self.key, name, LOOPBACK, one), ()) for name, one in self.clients),
            *((GrantInstalled(self.key, topic, LOOPBACK, caller), ()) for topic, caller in self.grants),
        ]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)
        self.listening.close()


class RelayDriver:
    def __init__(self, port: int = 0, rosmaster_port: int = 0, limits: str = "None") -> None:
        self.granting = True
        self._server = _Server((LOOPBACK, port), _Handler, logRequests=False, allow_none=True)
        self._server.register_instance(self)
        self.uri = f"http://{LOOPBACK}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self.faces: dict[str, Face] = {}
        self.numbers = itertools.count()
        self._gone: list[Face] = []
        self._lock = threading.RLock()
        self._rosmaster_port = rosmaster_port or free_port()
        self.rosmaster = subprocess.Popen(
            ["rosmaster", "--core", "-p", str(self._rosmaster_port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "ROS_IP": LOOPBACK, "PYTHONWARNINGS": "ignore"},
        )
        self._master_uri = f"http://{LOOPBACK}:{self._rosmaster_port}/"
        self.relay = RelayProcess(limits)
        self.link = self.relay.open_link(self._received)

    def __enter__(self) -> "RelayDriver":
        eventually(lambda: _answers(self._rosmaster_port), "rosmaster answers")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.relay.stop()
        self.link.close()
        self._server.shutdown()
        self._server.server_close()
        for face in [*self.faces.values(), *self._gone]:
            face.close()
        self.rosmaster.terminate()
        self.rosmaster.wait(LIMIT)

    def restart_control(self, *, leave_out: Callable[[Message], bool] = lambda _message: False) -> None:
        self.link.close()
        self.link = self.relay.open_link(self._received)
        self.link.send(StateBegan(7))
        for face in self.faces.values():
            for message, descriptors in face.statements():
                if not leave_out(message):
                    self.link.send(message, descriptors)
        self.link.send(StateEnded(7))
        self.relay.ping(7)

    def environment(self) -> dict[str, str]:
        return {**os.environ, "ROS_MASTER_URI": self.uri, "ROS_IP": LOOPBACK, "PYTHONWARNINGS": "ignore"}

    def _face(self, name: str, uri: str) -> Face:
        with self._lock:
            face = self.faces.get(name)
            if face is None or face.real_uri != uri:
                if face is not None:
                    self.link.send(FactWithdrawn(("node", face.key)))
                    self._gone.append(face)
                face = Face(self, name, uri)
                self.faces[name] = face
                self.link.send(*face.statements()[0])
            return face

    def _dispatch(self, method: str, parameters: tuple[Any, ...]) -> Any:
        arguments = list(parameters)
        if method in {
            "registerPublisher",
            "registerSubscriber",
            "unregisterPublisher",
            "unregisterSubscriber",
        }:
            face = self._face(arguments[0], arguments[-1])
            arguments[-1] = face.uri
            if method == "registerPublisher":
                face.publications[arguments[1]] = arguments[2]
                self.link.send(PublicationPlaced(face.key, arguments[1], arguments[2]))
            elif method == "unregisterPublisher":
                face.publications.pop(arguments[1], None)
                self.link.send(FactWithdrawn(("publication", face.key, arguments[1])))
        elif method == "registerService":
            face = self._face(arguments[0], arguments[3])
            port = _port(arguments[2])
            face.services[arguments[1]] = port
            self.link.send(ServicePlaced(face.key, arguments[1], LOOPBACK, port))
            self._grant(face, arguments[1], "/client")
            arguments[2:] = [f"rosrpc://{LOOPBACK}:{face.port}", face.uri]
        elif method == "lookupService":
            for face in list(self.faces.values()):
                if arguments[1] in face.services:
                    self._grant(face, arguments[1], arguments[0])
        elif method == "unregisterService":
            face = self.faces[arguments[0]]
            face.services.pop(arguments[1], None)
            self.link.send(FactWithdrawn(("service", face.key, arguments[1])))
            arguments[2] = f"rosrpc://{LOOPBACK}:{face.port}"
        elif method == "subscribeParam":
            arguments[1] = self._face(arguments[0], arguments[1]).uri
        return call(self._master_uri, method, *arguments)

    def _grant(self, face: Face, service: str, caller_id: str) -> None:
        face.clients.add((service, caller_id))
        self.link.send(ClientGranted(face.key, service, LOOPBACK, caller_id))

    def _received(self, message: Any) -> None:
        if isinstance(message, UpstreamWanted):
            threading.Thread(target=self._answer_upstream, args=(message,), daemon=True).start()

    def _answer_upstream(self, message: UpstreamWanted) -> None:
        with contextlib.suppress(ChannelClosedError, OSError):  # the test may end first, and close the link
            self._find_upstream(message)

    def _find_upstream(self, message: UpstreamWanted) -> None:
        face = next((face for face in self.faces.values() if face.key == message.key), None)
        if face is None:
            return
        try:
            _code, text, where = call(face.real_uri, "requestTopic", "/rosrv", message.topic, [["TCPROS"]])
        except OSError as error:
            self.link.send(UpstreamRefused(message.key, message.topic, str(error)))
            return
        if isinstance(where, list) and len(where) == 3:
            self.link.send(UpstreamFound(message.key, message.topic, LOOPBACK, int(where[2])))
        else:
            self.link.send(UpstreamRefused(message.key, message.topic, str(text)))


def call(uri: str, method: str, *arguments: Any) -> Any:
    with xmlrpc.client.ServerProxy(uri, allow_none=True) as proxy:
        return getattr(proxy, method)(*arguments)


def free_port() -> int:
    with socket.create_server((LOOPBACK, 0)) as sock:
        return int(sock.getsockname()[1])


def _answers(port: int) -> bool:
    with socket.socket() as sock:
        return sock.connect_ex((LOOPBACK, port)) == 0


def _port(uri: str) -> int:
    match = _URI.match(uri)
    assert match is not None, uri
    return int(match[2])


def _main() -> None:
    parser = argparse.ArgumentParser(description="A relay between ROS nodes, for measurements.")
    parser.add_argument("--master-port", type=int, default=0)
    parser.add_argument("--rosmaster-port", type=int, default=0)
    arguments = parser.parse_args()
    with RelayDriver(arguments.master_port, arguments.rosmaster_port) as driver:
        print(driver.uri, driver.relay.process.pid, flush=True)  # noqa: T201 - the caller reads them
        sys.stdin.read()


if __name__ == "__main__":
    _main()
