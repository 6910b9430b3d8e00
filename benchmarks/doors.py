"""A door beside rosbridge_suite and foxglove_bridge: `python -m benchmarks.doors [--rounds 3]`.

A roscpp node publishes strings, and WebSocket clients on another host of a lab count the frames that they receive.
The servers take turns, with messages of 200 bytes and of 1 MB, the size of a camera's frame:

- *paced*: one client and a fixed rate; the delay from `publish` to the client, and the processor time of a message.
- *most*: one client, then several on the same topic, like dashboards; the most frames a second that all clients
  received while the publisher's rate grew. The processor time of each process shows whether the publisher or a client
  is the limit, as all of them share the cores.
- *flooded*: a client sends messages to the door as fast as it can, while a node of the robot listens to another one.
  The client has the lowest priority, because a real flood comes from another machine.

The path through a door has two processes, the relay and the door. A door has a lower priority than the robot (nice
10), as on a robot, unless `--same-priority` is given. Neither peer is a Debian package: `--rosbridge`
(rosbridge_websocket.py of the branch ros1) and `--foxglove-bridge` name programs that start them. Without an option,
its rows are left out.
"""

import argparse
import json
import os
import re
import selectors
import signal
import socket
import statistics
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from examples.landshark.lab import Host, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import ROOT, RosSession
from tests.support.rosmaster import PlainMaster
from tests.support.waiting import eventually

_BENCHMARKS = ROOT / "build" / "benchmarks"
_LOAD, _ROBOT = _BENCHMARKS / "door_load", _BENCHMARKS / "recorder_load"
_SIZES = {200: (100, (8_000, 32_000, 64_000)), 1_000_000: (20, (100, 400, 1_600))}
"""The rate of *paced* and the rates of *most*, by the size of a message."""
_RECEIVED_BYTES = 1 << 18
_STAMP = re.compile(rb"t=([0-9a-f]{16})")
_HEAD_BYTES = 400
_WARM_SECONDS = 1.0
_CLIENTS = 20


class Viewer:
    """A WebSocket client that only finds the frames. A library would be slower than some of the servers."""

    def __init__(self, address: str, port: int, subprotocol: str = "") -> None:
        self.socket = socket.create_connection((address, port), timeout=20)
        self._data = bytearray()
        offered = f"Sec-WebSocket-Protocol: {subprotocol}\r\n" if subprotocol else ""
        self.socket.sendall(
            f"GET / HTTP/1.1\r\nHost: {address}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n{offered}\r\n".encode()
        )
        while b"\r\n\r\n" not in self._data:
            self._receive()
        head, _, rest = bytes(self._data).partition(b"\r\n\r\n")
        if b" 101 " not in head.partition(b"\r\n")[0]:
            raise SystemExit(f"{address}:{port} refused the WebSocket: {head.decode()}")
        self._data[:] = rest

    def close(self) -> None:
        self.socket.close()

    def send(self, **message: object) -> None:
        self.socket.sendall(frame_of(json.dumps(message).encode()))

    def frames(self, head_bytes: int = _HEAD_BYTES) -> Iterator[tuple[int, bytes]]:
        data = self._data
        while True:
            length, head = (data[1] & 0x7F, 2) if len(data) >= 2 else (0, len(data) + 1)
            if length >= 126:
                head = 4 if length == 126 else 10
                length = int.from_bytes(data[2:head], "big")
            if len(data) < head + length:
                self._receive()
                continue
            opcode, found = data[0] & 0x0F, bytes(data[head : head + min(length, head_bytes)])
            del data[: head + length]
            yield opcode, found

    def rest(self) -> bytes:
        return bytes(self._data)

    def _receive(self) -> None:
        data = self.socket.recv(1 << 20)
        if not data:
            raise SystemExit("the server ended the connection")
        self._data += data


class FrameCounter:
    """Counts the frames that a connection receives, at a fraction of the server's cost."""

    def __init__(self) -> None:
        self.frames = 0
        self._skip = 0  # bytes of a frame that has begun
        self._rest = b""  # the begin of a head

    def add(self, data: bytes) -> None:
        data = self._rest + data
        position, end = self._skip, len(data)
        while position + 2 <= end:
            length, head = data[position + 1], 2
            if length >= 126:
                head = 4 if length == 126 else 10
                length = int.from_bytes(data[position + 2 : position + head], "big")
            if position + head > end:
                break
            position += head + length
            self.frames += 1
        self._skip, self._rest = max(position - end, 0), data[position:]


def frame_of(data: bytes) -> bytes:
    length = bytes([0x80 | len(data)]) if len(data) < 126 else struct.pack(">BH", 0x80 | 126, len(data))
    return b"\x81" + length + b"\0\0\0\0" + data


def subscribe_rosbridge(viewer: Viewer, compression: str) -> None:
    viewer.send(op="subscribe", topic="/load", type="std_msgs/String", compression=compression)


def subscribe_foxglove(viewer: Viewer, _compression: str) -> None:
    for opcode, data in viewer.frames(1 << 20):
        for channel in json.loads(data).get("channels", ()) if opcode == 1 else ():
            if channel["topic"] == "/load":
                viewer.send(op="subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
                return


class Way(NamedTuple):
    name: str
    system: "System"
    compression: str = "none"
    subprotocol: str = ""

    def open(self) -> Viewer:
        viewer = Viewer(self.system.address, self.system.port, self.subprotocol)
        (subscribe_foxglove if self.subprotocol else subscribe_rosbridge)(viewer, self.compression)
        return viewer


@dataclass
class System:
    """A server of clients. `session` has the robot's nodes behind it."""

    session: RosSession
    address: str
    port: int
    pids: Callable[[], Sequence[int]]
    """The processes on the path of a message. The last one serves the clients."""
    stop: Callable[[], object] = lambda: None


class Heard(NamedTuple):
    """The frames a second, the median and 99th percentile of their delay, and the processor time of each."""

    rate: float
    p50_us: float
    p99_us: float
    cpu_us: float


class Carried(NamedTuple):
    """The frames a second to all clients, and the microseconds that each process spends on a frame."""

    rate: float
    publisher_us: float
    relay_us: float
    server_us: float
    clients_us: float


def carried(way: Way, operator: Host, size: int, hertz: int, *, clients: int, seconds: float) -> Carried:
    talker = way.system.session.start([str(_LOAD), str(size), str(hertz)], label="talker")
    try:
        talker.wait_for(event="ready")
        return operator.run(lambda: _count_all(way, talker.popen.pid, clients, seconds))
    finally:
        talker.stop()


def _count_all(way: Way, publisher: int, clients: int, seconds: float) -> Carried:
    *relay, server = way.system.pids()

    def spent() -> tuple[float, float, float, float]:
        times = [processor_seconds(pid) for pid in (publisher, server)]
        return times[0], sum(map(processor_seconds, relay)), times[1], time.thread_time()

    viewers = [way.open() for _ in range(clients)]
    counters = [FrameCounter() for _ in viewers]
    with selectors.DefaultSelector() as selector:
        for viewer, counter in zip(viewers, counters, strict=True):
            counter.add(viewer.rest())
            selector.register(viewer.socket, selectors.EVENT_READ, counter)

        def receive(seconds: float) -> float:
            begins = time.monotonic()
            while (now := time.monotonic()) < begins + seconds:
                for key, _events in selector.select(0.1):
                    data = key.fileobj.recv(_RECEIVED_BYTES)  # type: ignore[union-attr]  # a socket
                    if not data:
                        raise SystemExit(f"{way.name} ended the connection")
                    key.data.add(data)
            return now - begins

        receive(_WARM_SECONDS)
        before, frames = spent(), sum(counter.frames for counter in counters)
        took = receive(seconds)
        after, frames = spent(), sum(counter.frames for counter in counters) - frames
    for viewer in viewers:
        viewer.close()
    each = ((end - begin) / max(frames, 1) * 1e6 for begin, end in zip(before, after, strict=True))
    return Carried(frames / took, *each)


def heard(way: Way, operator: Host, size: int, hertz: int, seconds: float) -> Heard:
    talker = way.system.session.start([str(_LOAD), str(size), str(hertz)], label="talker")
    try:
        talker.wait_for(event="ready")
        return operator.run(lambda: _count(way, seconds))
    finally:
        talker.stop()


def _count(way: Way, seconds: float) -> Heard:
    viewer = way.open()
    delays: list[int] = []
    pids, before, begins, ends = way.system.pids(), 0.0, 0.0, float("inf")
    for _opcode, data in viewer.frames():
        stamp = _STAMP.search(data)
        if stamp is None:
            continue
        now = time.monotonic_ns()
        if not begins:
            begins, ends = now + _WARM_SECONDS * 1e9, now + (_WARM_SECONDS + seconds) * 1e9
        elif now >= begins:
            before = before or sum(map(processor_seconds, pids))
            delays.append(now - int(stamp[1], 16))
        if now > ends:
            break
    spent = sum(map(processor_seconds, pids)) - before
    viewer.close()
    delays.sort()
    return Heard(
        len(delays) / seconds,
        delays[len(delays) // 2] / 1e3,
        delays[len(delays) * 99 // 100] / 1e3,
        spent / len(delays) * 1e6,
    )


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process, which `/proc/PID/stat` has only in steps of 10 ms."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def private_kb(pid: int) -> int:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return sum(int(one) for one in re.findall(r"Private_(?:Clean|Dirty): +(\d+)", text))


def memory(way: Way, operator: Host) -> tuple[float, float]:
    """Return the server's memory in MB, and the memory of each idle client in kB."""
    pid = way.system.pids()[-1]
    first = operator.run(way.open)
    threading.Event().wait(1)
    before = private_kb(pid)
    more = [operator.run(way.open) for _ in range(_CLIENTS)]
    threading.Event().wait(2)
    after = private_kb(pid)
    for viewer in (first, *more):
        viewer.close()
    return before / 1024, (after - before) / _CLIENTS


def robot_p50(way: Way, folder: Path, seconds: float) -> float:
    talker = way.system.session.start([str(_ROBOT), "talk", "1", "200", "100"], label="robot talker")
    talker.wait_for(event="ready")
    listener = way.system.session.start([str(_ROBOT), "listen", "1", str(folder / "heard")], label="robot")
    listener.wait_for(event="ready")
    threading.Event().wait(seconds)
    listener.interrupt()
    p50 = float(listener.wait_for(event="heard")["p50_us"])
    talker.stop()
    return p50


@contextmanager
def flood(way: Way, operator: Host) -> Iterator[list[int]]:
    """Flood the server during the block. The yielded list has the number of messages at its end."""
    over, sent = threading.Event(), [0]

    def work() -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
        viewer = Viewer(way.system.address, way.system.port)
        viewer.send(op="advertise", topic="/flood", type="std_msgs/String")
        many = frame_of(b'{"op":"publish","topic":"/flood","msg":{"data":"flood"}}') * 100
        while not over.is_set():
            viewer.socket.sendall(many)
            sent[0] += 100
        viewer.close()

    thread = threading.Thread(target=operator.run, args=(work,))
    thread.start()
    yield sent
    over.set()
    thread.join()


def peer(command: str, master: PlainMaster, home: Path, robot: Host, port: int) -> System:
    session = RosSession(master.master_uri, home, robot)
    process = session.start([command, f"_port:={port}"], label=Path(command).name)

    def listens() -> bool:
        try:
            robot.run(lambda: socket.create_connection((robot.address, port), 5)).close()
        except OSError:
            return False
        return True

    eventually(listens, process.story, 60)
    return System(
        session,
        robot.address,
        port,
        lambda: [process.popen.pid],
        stop=lambda: process.stop(with_signal=signal.SIGKILL),
    )


def door(appliance: Appliance, home: Path, robot: Host) -> System:
    appliance.rosrv("door", "add", "viewer", "--port", "9091")
    eventually(lambda: not appliance.row("door", "list")["trouble"], appliance.story)
    address = appliance.host.address
    pids = [*appliance.pids("relay"), *appliance.pids("door")]
    return System(RosSession(appliance.master_uri, home, robot), address, 9091, lambda: pids)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--sizes", type=int, nargs="+", choices=[*_SIZES], default=[*_SIZES])
    parser.add_argument("--same-priority", action="store_true", help="the door and its peers have the same")
    parser.add_argument("--only-most", action="store_true", help="leave out delays, memory and the flood")
    parser.add_argument("--rosbridge", metavar="PROGRAM")
    parser.add_argument("--foxglove-bridge", metavar="PROGRAM")
    given = parser.parse_args()
    for source, program in ((_LOAD.name, _LOAD), (_ROBOT.name, _ROBOT)):
        file = ROOT / "benchmarks" / "nodes" / f"{source}.cpp"
        subprocess.run([str(ROOT / "scripts" / "build-roscpp"), str(file), str(program)], check=True)
    with ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rosrv-benchmark-")))
        home.chmod(0o755)
        lab = stack.enter_context(Lab("rosrv-doors"))
        robot, operator = lab.host("robot", "10.77.0.10/24"), lab.host("operator", "10.77.0.20/24")
        appliance = stack.enter_context(Appliance(lab.host("appliance", "10.77.0.2/24"), policy=OPEN_POLICY))
        plain = stack.enter_context(PlainMaster(home, robot))
        own = door(appliance, home, robot)
        ways = [
            Way("door, Foxglove", own, subprotocol="foxglove.websocket.v1"),
            Way("door, cbor-raw", own, "cbor-raw"),
            Way("door, JSON", own),
        ]
        if given.foxglove_bridge:
            bridge = peer(given.foxglove_bridge, plain, home, robot, 8765)
            ways.append(Way("foxglove_bridge", bridge, subprotocol="foxglove.websocket.v1"))
        if given.rosbridge:
            suite = peer(given.rosbridge, plain, home, robot, 9090)
            ways += [Way("rosbridge_suite, cbor-raw", suite, "cbor-raw"), Way("rosbridge_suite, JSON", suite)]
        for system in {id(way.system): way.system for way in ways}.values():
            stack.enter_context(system.session)
            stack.callback(system.stop)
        if given.same_priority:
            for way in ways:
                for pid in way.system.pids():
                    os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0))
        for size in given.sizes:
            if not given.only_most:
                show_delays(ways, operator, size, given.rounds, given.seconds)
            for clients in given.clients:
                show_most(ways, operator, size, clients=clients, rounds=given.rounds, seconds=given.seconds)
        if not given.only_most:
            show_memory(ways, operator)
            show_flood(ways[2], operator, home, given.rounds, given.seconds)
    Console().print(f"load average of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def show_delays(ways: Sequence[Way], operator: Host, size: int, rounds: int, seconds: float) -> None:
    hertz, _rates = _SIZES[size]
    paced: dict[str, list[Heard]] = {way.name: [] for way in ways}
    for _ in range(rounds):
        for way in ways:
            paced[way.name].append(heard(way, operator, size, hertz, seconds))
    table = Table("", "p50 µs", "p99 µs", "cpu µs", title=f"{size:,} bytes, {hertz} Hz")
    for name, found in paced.items():
        figures = [
            statistics.median(getattr(one, field) for one in found)
            for field in ("p50_us", "p99_us", "cpu_us")
        ]
        table.add_row(name, *(f"{figure:,.0f}" for figure in figures))
    Console().print(table)


def show_most(
    ways: Sequence[Way], operator: Host, size: int, *, clients: int, rounds: int, seconds: float
) -> None:
    _hertz, rates = _SIZES[size]
    most: dict[str, list[Carried]] = {way.name: [] for way in ways}
    for _ in range(rounds):
        for way in ways:
            most[way.name].append(
                max(carried(way, operator, size, rate, clients=clients, seconds=seconds) for rate in rates)
            )
    fields = [field.removesuffix("_us") for field in Carried._fields[1:]]
    table = Table(
        "",
        "frames a second",
        *(f"{field} µs" for field in fields),
        title=f"{size:,} bytes, {clients} clients: processor time of each process for a frame to a client",
    )
    for name, found in most.items():
        rate, *each = (statistics.median(figures) for figures in zip(*found, strict=True))
        table.add_row(name, f"{rate:,.0f}", *(f"{figure:,.1f}" for figure in each))
    Console(width=140).print(table)


def show_memory(ways: Sequence[Way], operator: Host) -> None:
    table = Table("", "private MB", f"kB for each of {_CLIENTS} idle clients")
    for way in ways:
        talker = way.system.session.start([str(_LOAD), "200", "1"], label="talker")
        talker.wait_for(event="ready")
        whole, each = memory(way, operator)
        talker.stop()
        table.add_row(way.name, f"{whole:.1f}", f"{each:.0f}")
    Console().print(table)


def show_flood(way: Way, operator: Host, home: Path, rounds: int, seconds: float) -> None:
    calm, flooded, frames = [], [], 0
    for _ in range(rounds):
        calm.append(robot_p50(way, home, 2 * seconds))
        with flood(way, operator) as sent:
            flooded.append(robot_p50(way, home, 2 * seconds))
        frames += sent[0]
    Console().print(
        f"the robot's p50: {statistics.median(calm):.0f} µs, beside a flooded door {statistics.median(flooded):.0f} µs "
        f"(rounds: {', '.join(f'{b / a:.2f}' for a, b in zip(calm, flooded, strict=True))}; {frames:,} frames)"
    )


if __name__ == "__main__":
    main()
