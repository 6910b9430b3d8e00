"""Measure a robot's delays under attack: `python -m benchmarks.attacks [--only loop,flood] [--busy N] [--seconds S]`.

The robot publishes a topic without a monitor at 100 Hz, and makes 20 calls a second on new connections and 20 on a
kept one. Guests, and hosts that no rule names, run the attacks one after the other, then in combinations. Rows have
the delays in milliseconds, the lost messages, the unanswered calls and the restarted relays. `--busy N` adds N
processes that only compute. The probes run at real-time priority, which requires root.
"""

import argparse
import contextlib
import http.client
import itertools
import json
import multiprocessing
import os
import select
import selectors
import shutil
import socket
import socketserver
import statistics
import struct
import tempfile
import threading
import time
import xmlrpc.client
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from examples.landshark.lab import Host, Lab
from roswire.errors import PeerError
from roswire.xmlrpc import parse_response
from tests.support.appliance import Appliance

HERE = Path(__file__).parent
APPLIANCE, ROBOT, OPERATOR = "10.77.0.2", "10.77.0.10", "10.77.0.20"
MASTER = f"http://{APPLIANCE}:11311/"
GUEST = ["10.77.1.1"]
UNKNOWN = [f"10.77.2.{number}" for number in range(1, 201)]
POLICY = """\
[Groups]
team = 10.77.0.10 10.77.0.20
guests = 10.77.1.0/24
[Nodes]
default = team
/guest/** = *
[Publishers]
default = team
/guest/** = *
/landshark/scan = team guests
[Subscribers]
default = team
/guest/** = *
[Services]
default = team
[Clients]
default = team
/guest/** = *
[Parameters]
read default = *
write default = team
[Commands]
default = *
"""
MD5 = {
    "std_msgs/String": "992ce8a1687cec8c8bd883ec73ca41d1",
    "std_msgs/UInt32": "304a39449588c7f8ce2df6e8001c5fce",
    "std_msgs/UInt64": "1b2a79973e8bf53d7b53acb71299cb57",
    "std_msgs/Empty": "d41d8cd98f00b204e9800998ecf8427e",
    "sensor_msgs/LaserScan": "90c7ef2dc6895d81024acba2ac42f369",
    "sensor_msgs/JointState": "3066dcd76a6cfaef579bd0f34173e9fd",
}
CONTEXT = multiprocessing.get_context("fork")
PROBES = ("topic", "new calls", "kept calls")
PATIENCE = 20.0  # seconds after which a call counts as unanswered
_TRIES = 20


# The parts of TCPROS and of the node API that a load needs


def header(**fields: str) -> bytes:
    body = b"".join(
        struct.pack("<I", len(line)) + line for line in (f"{k}={v}".encode() for k, v in fields.items())
    )
    return struct.pack("<I", len(body)) + body


def receive(sock: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        piece = sock.recv(size - len(data))
        if not piece:
            raise ConnectionError("closed")
        data += piece
    return bytes(data)


def read_header(sock: socket.socket) -> dict[str, str]:
    rest, fields = receive(sock, struct.unpack("<I", receive(sock, 4))[0]), {}
    while rest:
        size = struct.unpack_from("<I", rest)[0]
        name, _, value = rest[4 : 4 + size].decode().partition("=")
        fields[name], rest = value, rest[4 + size :]
    return fields


def frame(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


def text(value: bytes) -> bytes:
    return frame(value)


class _NodeApi(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        size = 0
        while (line := self.rfile.readline()) not in (b"\r\n", b""):
            name, _, value = line.partition(b":")
            size = int(value) if name.lower() == b"content-length" else size
        asked = b"requestTopic" in self.rfile.read(size)
        assert isinstance(self.server, _NodeServer)
        place = ["TCPROS", self.connection.getsockname()[0], self.server.tcpros]
        body = xmlrpc.client.dumps(([1, "", place if asked else 0],), methodresponse=True).encode()
        self.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))


class _NodeServer(socketserver.ThreadingTCPServer):
    tcpros: int
    daemon_threads = allow_reuse_address = True
    request_queue_size = 1024


class Nodes:
    def __init__(self) -> None:
        self._api = _NodeServer(("", 0), _NodeApi)
        self._listener = socket.create_server(("", 0), backlog=1024)
        self._api.tcpros = self.port = self._listener.getsockname()[1]
        self._peers: list[tuple[str, socket.socket]] = []
        self._changed = threading.Condition()
        for serve in (self._api.serve_forever, self._accept):
            threading.Thread(target=serve, daemon=True).start()

    def uri(self, address: str) -> str:
        return f"http://{address}:{self._api.server_address[1]}/"

    def publish(self, address: str, node: str, topic: str, type_name: str) -> None:
        answer = call(address, "registerPublisher", node, topic, type_name, self.uri(address))
        assert answer[0] == 1, answer

    def serve(self, address: str, node: str, service: str) -> None:
        answer = call(
            address, "registerService", node, service, f"rosrpc://{address}:{self.port}", self.uri(address)
        )
        assert answer[0] == 1, answer

    def peers(self, topic: str, count: int) -> list[socket.socket]:
        with self._changed:

            def found() -> list[socket.socket]:
                return [sock for name, sock in self._peers if name == topic]

            self._changed.wait_for(lambda: len(found()) >= count, 30)
            assert len(found()) >= count, f"{len(found())} of {count} connections for {topic}"
            return found()

    def _accept(self) -> None:
        while True:
            sock, _ = self._listener.accept()
            threading.Thread(target=self._greet, args=(sock,), daemon=True).start()

    def _greet(self, sock: socket.socket) -> None:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            asked = read_header(sock)
            if "service" in asked:
                md5sum = "51da076440d78ca1684d36c868df61ea"
                types = {
                    "request_type": "roscpp/SetLoggerLevelRequest",
                    "response_type": "roscpp/SetLoggerLevelResponse",
                }
                sock.sendall(header(callerid="/server", md5sum=md5sum, type="roscpp/SetLoggerLevel", **types))
                while True:
                    receive(sock, struct.unpack("<I", receive(sock, 4))[0])
                    sock.sendall(b"\x01" + frame(b""))
            topic = asked["topic"]
            type_name = TYPES[topic]
            sock.sendall(
                header(
                    callerid="/p",
                    topic=topic,
                    type=type_name,
                    md5sum=MD5[type_name],
                    latching="0",
                    message_definition=DEFINITIONS[type_name],
                )
            )
            with self._changed:
                self._peers.append((topic, sock))
                self._changed.notify_all()


TYPES = {
    "/probe": "std_msgs/UInt64",
    "/guest/loop": "std_msgs/String",
    "/landshark/scan": "sensor_msgs/LaserScan",
    "/guest/joints": "sensor_msgs/JointState",
    "/guest/make": "std_msgs/UInt32",
    "/guest/touch": "std_msgs/Empty",
    "/guest/flood": "std_msgs/UInt64",
}
_HEADER = "\n" + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
DEFINITIONS = {
    "std_msgs/String": "string data\n",
    "std_msgs/UInt32": "uint32 data\n",
    "std_msgs/UInt64": "uint64 data\n",
    "std_msgs/Empty": "",
    "sensor_msgs/LaserScan": "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n"
    "float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\n"
    "float32[] intensities\n" + _HEADER,
    "sensor_msgs/JointState": "Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _HEADER,
}


def call(address: str, method: str, *params: Any, uri: str = MASTER) -> Any:
    place = uri.removeprefix("http://").rstrip("/")
    host, _, port = place.rpartition(":")
    tries = 0
    while True:
        connection = http.client.HTTPConnection(
            host, int(port), timeout=PATIENCE, source_address=(address, 0)
        )
        try:
            with contextlib.closing(connection):
                connection.request("POST", "/RPC2", xmlrpc.client.dumps(params, method).encode())
                answer: Any = parse_response(connection.getresponse().read())
                return answer
        except (OSError, http.client.HTTPException, PeerError):
            if (tries := tries + 1) == _TRIES:
                raise
            time.sleep(0.2)  # noqa: TID251  the pace of the load


def subscribe(nodes: Nodes, address: str, node: str, topic: str) -> list[socket.socket]:
    type_name, connections = TYPES[topic], []
    code, reason, publishers = call(address, "registerSubscriber", node, topic, type_name, nodes.uri(address))
    assert code == 1, reason
    for publisher in publishers:
        code, reason, place = call(address, "requestTopic", node, topic, [["TCPROS"]], uri=publisher)
        assert code == 1, reason
        sock = socket.create_connection((place[1], place[2]), PATIENCE, source_address=(address, 0))
        sock.sendall(
            header(callerid=node, topic=topic, type=type_name, md5sum=MD5[type_name], tcp_nodelay="1")
        )
        read_header(sock)
        connections.append(sock)
    return connections


# Measurements of the robot


def probe_messages(seconds: float, robot: Host, operator: Host, answers: Connection, begin: Event) -> None:
    """Publish for `seconds` whenever `begin` is set, and send the delays and the losses."""
    realtime()
    with robot.entered():
        nodes = Nodes()
        nodes.publish(ROBOT, "/probe_source", "/probe", "std_msgs/UInt64")
    with operator.entered():
        ear = Nodes()

    def connect() -> tuple[socket.socket, socket.socket]:
        known = len(nodes.peers("/probe", 0))
        with operator.entered():
            sink = subscribe(ear, OPERATOR, "/probe_sink", "/probe")[0]
        source = nodes.peers("/probe", known + (0 if known and not lost else 1))[-1]
        return source, sink

    lost, number = False, 0
    source, sink = connect()
    answers.send("ready")
    while True:
        begin.wait()
        sent: dict[int, float] = {}
        delays: list[float] = []
        rest, missing = b"", 0
        start = due = time.monotonic()
        while (now := time.monotonic()) < start + seconds + 5:
            if now >= start + seconds and not sent:
                break
            try:
                if now >= due and now < start + seconds:
                    number += 1
                    sent[number] = now
                    source.sendall(struct.pack("<IQ", 8, number))
                    due += 0.01
                elif select.select([sink], [], [], max(0.0, min(due - now, 0.01)))[0]:
                    data = sink.recv(1 << 16)
                    if not data:
                        raise ConnectionError("the relay closed the connection")
                    came, rest = time.monotonic(), rest + data
                    while len(rest) >= 12:
                        began = sent.pop(struct.unpack_from("<Q", rest, 4)[0], None)
                        rest = rest[12:]
                        if (
                            began is not None
                        ):  # otherwise it is a message of the earlier round, which counted it as lost
                            delays.append(came - began)
            except OSError:
                missing, sent, rest, lost = missing + len(sent), {}, b"", True
                source, sink = connect()
                missing += max(0, int((time.monotonic() - due) * 100))
                due = time.monotonic()
        answers.send((delays, Counter(lost=missing + len(sent))))
        begin.clear()


def probe_calls(seconds: float, robot: Host, keep: bool, answers: Connection, begin: Event) -> None:
    """Make 20 calls a second whenever `begin` is set, on one connection if `keep` is set.

    A round ends after three times its length, and its remaining calls count as errors.
    """
    realtime()
    body = xmlrpc.client.dumps(("/looker", "/rosdistro"), "getParam").encode()
    with robot.entered():
        answers.send("ready")
        while True:
            begin.wait()
            delays, errors, connection = [], Counter[str](), None
            start = time.monotonic()
            for turn in range(round(seconds * 20)):
                wait = start + turn * 0.05 - time.monotonic()
                if wait > 0:
                    time.sleep(wait)  # noqa: TID251  the pace of the load
                if (began := time.monotonic()) > start + 3 * seconds:
                    errors["not made in time"] += 1
                    continue
                try:
                    if connection is None:
                        connection = http.client.HTTPConnection(APPLIANCE, 11311, timeout=PATIENCE)
                    connection.request("POST", "/RPC2", body)
                    answer = connection.getresponse()
                    answer.read()
                    if answer.status != 200:
                        raise http.client.HTTPException(answer.status)
                    delays.append(time.monotonic() - began)
                except (OSError, http.client.HTTPException) as error:
                    errors[type(error).__name__] += 1
                    keep_open, connection = False, None
                else:
                    keep_open = keep
                if not keep_open and connection is not None:
                    connection.close()
                    connection = None
            answers.send((delays, errors))
            begin.clear()


def realtime() -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


# Attacks: each one runs in the crowd's namespace with its addresses, calls `go()` when it has begun, and never returns


class Pipes:
    def __init__(self, socks: Sequence[socket.socket]) -> None:
        self._rest: dict[socket.socket, memoryview] = {}
        self.socks = list(socks)
        for sock in self.socks:
            sock.setblocking(False)
        self.sent = 0

    def send(self, data: bytes) -> None:
        for sock in list(self.socks):
            view = self._rest.pop(sock, None) or memoryview(data)
            try:
                count = sock.send(view)
            except BlockingIOError:
                count = 0
            except OSError:
                self.socks.remove(sock)
                continue
            if count < len(view):
                self._rest[sock] = view[count:]
            self.sent += count

    def at(self, rate: float, data: bytes) -> None:
        for turn in itertools.count():
            if turn == 0:
                start = time.monotonic()
            time.sleep(max(0.0, start + turn / rate - time.monotonic()))  # noqa: TID251  the pace of the load
            self.send(data)


def published(nodes: Nodes, addresses: Sequence[str], topic: str, *, listen: bool = False) -> Pipes:
    for number, address in enumerate(addresses):
        nodes.publish(address, f"/guest/n{number}_{topic.rpartition('/')[2]}", topic, TYPES[topic])
    if listen:
        for sock in subscribe(nodes, addresses[0], f"/guest/ear_{topic.rpartition('/')[2]}", topic):
            threading.Thread(target=_drain, args=(sock,), daemon=True).start()
    return Pipes(nodes.peers(topic, len(addresses)))


def _drain(sock: socket.socket) -> None:
    buffer = bytearray(1 << 20)
    with contextlib.suppress(OSError):
        while sock.recv_into(buffer):
            pass


def loop(addresses: Sequence[str], go: Callable[[], None]) -> None:
    """Send 0.8 MB/s on a guest's own topic, whose monitor loops over a string."""
    pipes = published(Nodes(), addresses, "/guest/loop")
    go()
    pipes.at(8 / len(addresses), frame(text(b"y" * 100_000)))


def scans(addresses: Sequence[str], go: Callable[[], None]) -> None:
    """Send two scans of 200,000 ranges a second to the shipped obstacle monitor."""
    pipes = published(Nodes(), addresses, "/landshark/scan")
    head = struct.pack("<III", 1, 0, 0) + text(b"") + struct.pack("<7f", 0, 0, 0, 0, 0, 0, 0)
    go()
    pipes.at(
        2 / len(addresses),
        frame(head + struct.pack("<I", 200_000) + struct.pack("<f", 9.0) * 200_000 + struct.pack("<I", 0)),
    )


def joints(addresses: Sequence[str], go: Callable[[], None]) -> None:
    """Send two messages a second in which a million empty strings (4 MB) precede the field that a monitor reads."""
    pipes = published(Nodes(), addresses, "/guest/joints")
    body = struct.pack("<III", 1, 0, 0) + text(b"") + struct.pack("<I", 1_000_000) + bytes(4_000_000)
    go()
    pipes.at(2 / len(addresses), frame(body + struct.pack("<Id", 1, 0.5) + bytes(8)))


def six_joints(addresses: Sequence[str], go: Callable[[], None]) -> None:
    """Send the messages of `joints` from six publishers at once, as fast as they are read."""
    nodes = Nodes()
    for number in range(6):
        for index, address in enumerate(addresses[: max(1, len(addresses) // 6)]):
            nodes.publish(address, f"/guest/six{number}_{index}", "/guest/joints", TYPES["/guest/joints"])
    pipes = Pipes(nodes.peers("/guest/joints", 6))
    body = struct.pack("<III", 1, 0, 0) + text(b"") + struct.pack("<I", 1_000_000) + bytes(4_000_000)
    go()
    pipes.at(20, frame(body + struct.pack("<Id", 1, 0.5) + bytes(8)))


def slices(addresses: Sequence[str], go: Callable[[], None]) -> None:
    nodes = Nodes()
    make = published(nodes, addresses, "/guest/make")
    touch = published(nodes, addresses, "/guest/touch")
    for sock in make.socks:
        sock.setblocking(True)
    for number in range(20_000):
        with contextlib.suppress(ConnectionError):  # cut because of other attacks from this host
            make.socks[number % len(make.socks)].sendall(frame(struct.pack("<I", number)))
    go()
    touch.at(50 / len(addresses), frame(b""))


def flood(addresses: Sequence[str], go: Callable[[], None]) -> None:
    pipes = published(Nodes(), addresses, "/guest/flood", listen=True)
    go()
    while True:
        select.select([], pipes.socks, [])
        pipes.send(struct.pack("<IQ", 8, 0) * 5000)


def kept(addresses: Sequence[str], go: Callable[[], None]) -> None:
    body = xmlrpc.client.dumps(("/guest/looker", "/rosdistro"), "getParam").encode()
    request = b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body)
    selector = selectors.DefaultSelector()
    for number in range(500):
        with contextlib.suppress(OSError):
            sock = socket.create_connection(
                (APPLIANCE, 11311), 2, source_address=(addresses[number % len(addresses)], 0)
            )
            sock.sendall(request)
            selector.register(sock, selectors.EVENT_READ)
        if number == 50:
            go()
    while True:
        for key, _ in selector.select(1):
            assert isinstance(key.fileobj, socket.socket)
            sock = key.fileobj
            try:
                if not sock.recv(1 << 16):
                    raise ConnectionError
                sock.sendall(request)
            except OSError:
                selector.unregister(sock)
                sock.close()


def multicalls(addresses: Sequence[str], go: Callable[[], None]) -> None:
    """Send multicalls of 9,000 reads on 16 connections, while an unknown host opens 60 connections a second."""
    part = {"methodName": "getParam", "params": ["/guest/looker", "/rosdistro"]}
    body = xmlrpc.client.dumps(([part] * 9000,), "system.multicall").encode()

    def repeat(address: str) -> None:
        while True:
            with contextlib.suppress(OSError, http.client.HTTPException):
                connection = http.client.HTTPConnection(
                    APPLIANCE, 11311, timeout=60, source_address=(address, 0)
                )
                while True:
                    connection.request("POST", "/RPC2", body)
                    connection.getresponse().read()

    for number in range(16):
        threading.Thread(target=repeat, args=(addresses[number % len(addresses)],), daemon=True).start()
    go()
    for turn in itertools.count():
        with contextlib.suppress(OSError):
            sock = socket.create_connection((APPLIANCE, 11311), 1, source_address=(UNKNOWN[turn % 200], 0))
            sock.sendall(b"POST /RPC2 HTTP/1.1\r\n")
            threading.Timer(1, sock.close).start()
        time.sleep(1 / 60)  # noqa: TID251  the pace of the load


def service(addresses: Sequence[str], go: Callable[[], None]) -> None:
    place = call(addresses[0], "lookupService", "/guest/asker", "/guest/service")[2].removeprefix("rosrpc://")
    host, _, port = place.rstrip("/").rpartition(":")
    socks = []
    for number, address in enumerate(addresses[:10]):
        node = f"/guest/asker{number}"
        call(address, "lookupService", node, "/guest/service")
        sock = socket.create_connection((host, int(port)), 5, source_address=(address, 0))
        sock.sendall(header(callerid=node, service="/guest/service", md5sum="*", persistent="1"))
        socks.append(sock)
        threading.Thread(target=_drain, args=(sock,), daemon=True).start()
    go()
    Pipes(socks).at(10 / len(socks), frame(text(b"y" * 100_000) + text(b"")))


def connections(addresses: Sequence[str], go: Callable[[], None]) -> None:
    code, _, uri = call(addresses[0], "lookupNode", "/guest/looker", "/probe_source")
    assert code == 1, uri
    place = (APPLIANCE, int(uri.rstrip("/").rpartition(":")[2]))
    go()
    for turn in itertools.count():
        for target in ((APPLIANCE, 11311), place):
            with contextlib.suppress(OSError):
                socket.create_connection(
                    target, 0.2, source_address=(addresses[turn % len(addresses)], 0)
                ).close()


ATTACKS: dict[str, tuple[Callable[..., None], ...]] = {
    "loop": (loop,),
    "scans": (scans,),
    "joints": (joints,),
    "six-joints": (six_joints,),
    "slices": (slices,),
    "flood": (flood,),
    "kept": (kept,),
    "multicalls": (multicalls,),
    "service": (service,),
    "connections": (connections,),
    "loop+flood+kept": (loop, flood, kept),
    "joints+slices+multicalls": (joints, slices, multicalls),
    "scans+service+connections": (scans, service, connections),
}


def attack(crowd: Host, function: Callable[..., None], addresses: Sequence[str]) -> tuple[Any, Event]:
    """Start an attack, and return its process and an event that is set when it is under way."""
    under_way = CONTEXT.Event()

    def run() -> None:
        with crowd.entered():
            function(addresses, under_way.set)

    process = CONTEXT.Process(target=run, daemon=True)
    process.start()
    return process, under_way


def burn() -> None:
    while True:
        sum(range(100_000))


class Rig:
    def __init__(self, lab: Lab, home: Path, seconds: float, relays: int) -> None:
        self.seconds = seconds
        middle = lab.host("appliance", f"{APPLIANCE}/16")
        self.robot, self.operator = lab.host("robot", f"{ROBOT}/16"), lab.host("operator", f"{OPERATOR}/16")
        self.crowd = lab.host("crowd", *(f"{address}/16" for address in (*GUEST, *UNKNOWN)))
        monitors = home / "monitors"
        monitors.mkdir()
        for file in (
            HERE / "attack_monitors" / "attacked.rv",
            HERE.parent / "monitors" / "obstacle_avoidance.rv",
        ):
            shutil.copy(file, monitors)
        options = ("--monitors", str(monitors), "--enable", "all")
        self.appliance = Appliance(middle, policy=POLICY, relays=relays, options=options)

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        with self.appliance, contextlib.ExitStack() as stack:
            self._probes = []
            with self.robot.entered():
                server = Nodes()
                server.serve(ROBOT, "/guest/server", "/guest/service")
            for probe, *arguments in (
                (probe_messages, self.seconds, self.robot, self.operator),
                (probe_calls, self.seconds, self.robot, False),
                (probe_calls, self.seconds, self.robot, True),
            ):
                ours, theirs = CONTEXT.Pipe()
                begin = CONTEXT.Event()
                process = CONTEXT.Process(target=probe, args=(*arguments, theirs, begin), daemon=True)
                process.start()
                stack.callback(process.kill)
                if not ours.poll(30):
                    raise TimeoutError(f"{probe.__name__} is not ready")
                ours.recv()
                self._probes.append((ours, begin))
            yield

    def measure(self) -> list[tuple[list[float], Counter[str]]]:
        for _, begin in self._probes:
            begin.set()
        return [ours.recv() for ours, _ in self._probes]

    def round(self, names: Sequence[Callable[..., None]], addresses: Sequence[str]) -> dict[str, Any]:
        before = {role: {*self.appliance.pids(role)} for role in ("relay", "control")}
        started: list[tuple[Any, Event]] = []
        try:
            for function in names:  # one after the other: an attack may use up what the next needs to begin
                started.append(attack(self.crowd, function, addresses))
                if not started[-1][1].wait(60):
                    raise TimeoutError(f"the attack {function.__name__} did not begin")
            found = self.measure()
        finally:
            for process, _ in started:
                process.kill()
                process.join()
        restarts = {role: len({*self.appliance.pids(role)} - pids) for role, pids in before.items()}
        row: dict[str, Any] = {"restarts": restarts}
        for name, (delays, errors) in zip(PROBES, found, strict=True):
            missing = errors.total()
            row[name] = figures(delays) | {"missing": missing, "of": len(delays) + missing, "errors": errors}
        return row


def figures(delays: Sequence[float]) -> dict[str, float]:
    if len(delays) < 2:
        return {"p50": float("nan"), "p99": float("nan"), "max": float("nan")}
    p99 = statistics.quantiles(delays, n=100, method="inclusive")[98]
    return {"p50": 1e3 * statistics.median(delays), "p99": 1e3 * p99, "max": 1e3 * max(delays)}


def main() -> None:
    parser = argparse.ArgumentParser(description="The robot's delays under attack")
    parser.add_argument("--only", help="attacks, separated by commas: " + ", ".join(ATTACKS))
    parser.add_argument("--by", default="guest,unknown", help="who attacks: guest, unknown")
    parser.add_argument("--busy", type=int, default=0, help="processes that only compute")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each round")
    parser.add_argument("--relays", type=int, default=1, help="relay processes of the appliance")
    given = parser.parse_args()
    chosen, attackers = given.only.split(",") if given.only else [*ATTACKS], given.by.split(",")
    for name in sorted({*chosen} - {*ATTACKS} | {*attackers} - {"guest", "unknown"}):
        parser.error(f"{name!r} is not an attack of --only or an attacker of --by; see --help")
    rows: list[tuple[str, str, dict[str, Any]]] = []
    with tempfile.TemporaryDirectory() as name, Lab("rosrv-bench") as lab:
        Path(name).chmod(0o755)  # the appliance's users read the specifications in it
        burners = [CONTEXT.Process(target=burn, daemon=True) for _ in range(given.busy)]
        for burner in burners:
            burner.start()
        rig = Rig(lab, Path(name), given.seconds, given.relays)
        with rig.running():
            rows.append(("quiet", "", rig.round((), ())))
            for what in chosen:
                for who in attackers:
                    if who == "unknown" and "scans" in what:
                        continue  # no rule lets an unknown host publish scans
                    rows.append((what, who, rig.round(ATTACKS[what], GUEST if who == "guest" else UNKNOWN)))
                    Console(stderr=True).print(json.dumps(rows[-1]), soft_wrap=True)
        for burner in burners:
            burner.kill()
    show(rows)


def show(rows: Sequence[tuple[str, str, dict[str, Any]]]) -> None:
    table = Table("attack", "by")
    for name in PROBES:
        table.add_column(f"{name}: p50 p99 max ms", justify="right")
        table.add_column("lost", justify="right")
    for column in ("relay restarts", "control restarts", "errors"):
        table.add_column(column, justify="right")
    for what, who, row in rows:
        cells, errors = [], Counter[str]()
        for name in PROBES:
            one = row[name]
            errors += one["errors"]
            cells += [f"{one['p50']:.1f} {one['p99']:.1f} {one['max']:.1f}", f"{one['missing']}/{one['of']}"]
        restarts = map(str, row["restarts"].values())
        table.add_row(what, who, *cells, *restarts, " ".join(f"{kind} {n}" for kind, n in errors.items()))
    Console(width=160).print(table)
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
