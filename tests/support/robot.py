"""Run a robot of a hundred nodes and two hundred topics.

The nodes of one machine share an API and a listener, on an address of the loopback (from 127.0.0.11), so that the
appliance sees a host for each machine of the robot.
"""

import contextlib
import http.client
import itertools
import math
import re
import socket
import struct
import threading
import xmlrpc.client
from collections.abc import Iterator
from socketserver import BaseRequestHandler, ThreadingMixIn, ThreadingTCPServer
from types import TracebackType
from typing import Any, Self
from xmlrpc.server import SimpleXMLRPCServer

from roswire.standard import standard_definitions
from roswire.tcpros import decode_header, encode_frame, encode_header

MACHINES = {
    "127.0.0.11": ("arm", "gripper", "safety", "base"),
    "127.0.0.12": ("camera", "lidar", "perception"),
    "127.0.0.13": ("navigation", "localization"),
    "127.0.0.14": ("operator",),
}
PARTS = (
    "driver", "controller", "planner", "filter", "estimator",
    "watchdog", "calibration", "bridge", "limiter", "reporter",
)  # fmt: skip
FLOWING = {
    "/arm/command": 50,
    "/arm/joint": 25,
    "/base/cmd_vel": 20,
    "/lidar/range": 10,
    "/camera/exposure": 5,
}
_TYPE = "std_msgs/Float64"
_LENGTH = struct.Struct("<I")


def nodes() -> Iterator[tuple[str, str]]:
    for machine, spaces in MACHINES.items():
        for space, part in itertools.product(spaces, PARTS):
            yield f"/{space}/{part}", machine


def publications() -> Iterator[tuple[str, str]]:
    own = {("/arm/planner", 0): "/arm/command", ("/arm/driver", 0): "/arm/joint", ("/base/planner", 0): "/base/cmd_vel",
           ("/lidar/driver", 0): "/lidar/range", ("/camera/driver", 0): "/camera/exposure"}  # fmt: skip
    for node, _machine in nodes():
        for number, name in enumerate(("output", "state")):
            yield node, own.get((node, number), f"{node}/{name}")


def subscriptions() -> Iterator[tuple[str, str]]:
    outputs: dict[str, str] = {}
    for node, topic in publications():
        outputs.setdefault(node, topic)
    for before, node in itertools.pairwise(outputs):
        if before.rsplit("/", 1)[0] == node.rsplit("/", 1)[0]:
            yield node, outputs[before]
    yield "/arm/controller", "/arm/command"
    yield "/safety/watchdog", "/arm/command"
    yield "/arm/planner", "/arm/joint"
    yield "/base/controller", "/base/cmd_vel"
    yield "/safety/watchdog", "/base/cmd_vel"
    yield "/navigation/planner", "/lidar/range"
    yield "/perception/filter", "/camera/exposure"
    yield "/operator/reporter", "/safety/watchdog/state"


class Robot:
    def __init__(self, master_uri: str) -> None:
        self._master_uri = master_uri
        self._machine = dict(nodes())
        self._machines: dict[str, _Machine] = {}
        self._stack = contextlib.ExitStack()

    def api(self, node: str) -> str:
        return self._machines[self._machine[node]].uri

    def call(self, node: str, method: str, *arguments: Any) -> Any:
        with _proxy(self._master_uri, self._machine[node]) as master:
            return getattr(master, method)(node, *arguments)

    def __enter__(self) -> Self:
        try:
            for address in MACHINES:
                self._machines[address] = self._stack.enter_context(_Machine(address))
            for node, topic in publications():
                assert self.call(node, "registerPublisher", topic, _TYPE, self.api(node))[0] == 1
            for node, topic in subscriptions():
                found = self.call(node, "registerSubscriber", topic, _TYPE, self.api(node))
                assert found[0] == 1
                if topic in FLOWING:
                    self._machines[self._machine[node]].hear(node, topic, found[2][0])
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


class _Machine:
    def __init__(self, address: str) -> None:
        self._address = address
        self._stack = contextlib.ExitStack()
        self._over = threading.Event()

    def __enter__(self) -> Self:
        over = self._over

        class Publish(BaseRequestHandler):
            def handle(self) -> None:
                _publish(self.request, over)

        self._publisher = _Listener((self._address, 0), Publish)
        self._api = _Api((self._address, 0), logRequests=False, allow_none=True)
        self._api.register_instance(self)
        for server in (self._publisher, self._api):
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            for ending in (server.server_close, thread.join, server.shutdown):
                self._stack.callback(ending)
        self._stack.callback(over.set)
        self.uri = f"http://{self._address}:{self._api.server_address[1]}/"
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    def _dispatch(self, method: str, _parameters: tuple[Any, ...]) -> list[Any]:
        if method == "requestTopic":
            return [1, "", ["TCPROS", self._address, self._publisher.server_address[1]]]
        return [1, "", 4711 if method == "getPid" else 0]

    def hear(self, node: str, topic: str, publisher: str) -> None:
        with _proxy(publisher, self._address) as api:
            _code, _text, (_protocol, host, port) = api.requestTopic(node, topic, [["TCPROS"]])
        connection = socket.create_connection((host, port), source_address=(self._address, 0))
        connection.sendall(encode_header(_header(topic) | {"callerid": node, "topic": topic}))
        thread = threading.Thread(target=_read, args=(connection,))
        thread.start()
        self._stack.callback(connection.close)
        self._stack.callback(thread.join)
        self._stack.callback(_end, connection)


class _Api(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True


class _Listener(ThreadingTCPServer):
    daemon_threads = True
    request_queue_size = 64


class _From(xmlrpc.client.Transport):
    def __init__(self, address: str) -> None:
        super().__init__()
        self._address = address

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = http.client.HTTPConnection(str(host), timeout=30, source_address=(self._address, 0))
        self._connection = host, connection  # closed by the proxy
        return connection


def _proxy(uri: str, address: str) -> Any:
    return xmlrpc.client.ServerProxy(uri, transport=_From(address), allow_none=True)


def _header(topic: str) -> dict[str, str]:
    return {"topic": topic, "type": _TYPE, "md5sum": _DEFINITIONS.md5sum(_TYPE)}


_DEFINITIONS = standard_definitions()


def _publish(connection: socket.socket, over: threading.Event) -> None:
    with contextlib.suppress(ConnectionError):  # it may end at any time
        _serve(connection, over)


def _serve(connection: socket.socket, over: threading.Event) -> None:
    (size,) = _LENGTH.unpack(_exactly(connection, 4))
    topic = decode_header(_exactly(connection, size))["topic"]
    answer = {
        "callerid": re.sub(r"/[^/]*$", "", topic) or topic,
        "message_definition": _DEFINITIONS.full_text(_TYPE),
    }
    connection.sendall(encode_header(_header(topic) | answer | {"latching": "0"}))
    rate = FLOWING.get(topic)
    if rate is None:
        connection.recv(1)
        return
    for number in itertools.count():
        connection.sendall(encode_frame(struct.pack("<d", math.sin(number / rate))))
        if over.wait(1 / rate):
            return


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        more = connection.recv(size - len(data))
        if not more:
            raise ConnectionError("the subscriber closed before its header arrived")
        data += more
    return data


def _read(connection: socket.socket) -> None:
    with contextlib.suppress(ConnectionError):
        while connection.recv(65536):
            pass


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # the other side has closed it
        connection.shutdown(socket.SHUT_RDWR)
