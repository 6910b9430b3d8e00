"""RVMaster beside plain `rosmaster`: `python -m benchmarks.control_plane [--seconds 2] [--rounds 3] [--only CALL]`.

Both run at the same time, the appliance as `rosrv up` starts it, and take turns at every load. Cells are medians of
the rounds. `ratio` is the median of the rounds' ratios, and `added` the difference between the median delays of a
call. RVMaster's processor time includes that of the master that it hides.
"""

import argparse
import json
import os
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

POLICY = """
[Groups]
here = 127.0.0.0/8
[Nodes]
default = here
[Publishers]
default = here
[Subscribers]
default = here
[Commands]
default = here
"""
READS: dict[str, tuple[Any, ...]] = {
    "getParam": ("/bench/read",),
    "hasParam": ("/bench/read",),
    "lookupNode": ("/bench_node_7",),
    "getSystemState": (),
    "getPublishedTopics": ("",),
    "getTopicTypes": (),
}
OPERATIONS = (*READS, "register/unregister", "setParam/getParam", "20 getParam as one", "20 setParam as one")
NODES, TOPICS = 20, 5  # registered during the measurement: nodes, and topics of each node
LOADS = ((1, True), (1, False), (16, True), (16, False))


def request(method: str, *params: Any, keep: bool) -> bytes:
    body = xmlrpc.client.dumps(params, method).encode()
    connection = "keep-alive" if keep else "close"
    head = f"POST / HTTP/1.1\r\nHost: x\r\nConnection: {connection}\r\nContent-Type: text/xml\r\n"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def requests(operation: str, client: int, keep: bool) -> list[bytes]:
    me, api = f"/bench_{client}", f"http://127.0.0.1:{40000 + client}/"
    topic, key = f"/bench/topic_{client}", f"/bench/key_{client}"
    if operation in READS:
        return [request(operation, me, *READS[operation], keep=keep)]
    if operation == "register/unregister":
        return [
            request("registerPublisher", me, topic, "std_msgs/String", api, keep=keep),
            request("unregisterPublisher", me, topic, api, keep=keep),
        ]
    if operation == "setParam/getParam":
        return [request("setParam", me, key, 42, keep=keep), request("getParam", me, key, keep=keep)]
    method = operation.split()[1]
    params = [[me, f"{key}_{one}", one][: 2 if method == "getParam" else 3] for one in range(20)]
    parts = [{"methodName": method, "params": param} for param in params]
    return [request("system.multicall", parts, keep=keep)]


def furnish(port: int) -> None:
    with xmlrpc.client.ServerProxy(f"http://127.0.0.1:{port}/") as master:
        for node in range(NODES):
            for topic in range(TOPICS):
                what = (
                    f"/robot/part_{node}/topic_{topic}",
                    "std_msgs/String",
                    f"http://127.0.0.1:{41000 + node}/",
                )
                master.registerPublisher(f"/bench_node_{node}", *what)
        master.setParam("/bench", "/bench/read", 42)
        for client in range(16):
            for one in range(20):
                master.setParam("/bench", f"/bench/key_{client}_{one}", one)


class Client:
    """A caller that makes the `wanted` calls in turn. `delays` has the seconds of each call, `answer` the last body."""

    def __init__(self, port: int, wanted: list[bytes], keep: bool, host: str = "127.0.0.1") -> None:
        self.delays: list[float] = []
        self._port, self.wanted, self._keep, self._host = port, wanted, keep, host
        self._next = 0
        self.answer = b""
        self._buffer = b""
        self.sock: socket.socket | None = None

    def send(self) -> socket.socket:
        self._began = time.perf_counter()
        if self.sock is None:
            self.sock = socket.create_connection(("127.0.0.1", self._port), source_address=(self._host, 0))
            self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.sendall(self.wanted[self._next % len(self.wanted)])
        self._next += 1
        self._buffer = b""
        return self.sock

    def receive(self) -> bool:
        assert self.sock is not None
        piece = self.sock.recv(1 << 20)
        self._buffer += piece
        head, mark, body = self._buffer.partition(b"\r\n\r\n")
        if not mark:
            if not piece:
                raise ConnectionError("the connection ended in an answer")
            return False
        length = int(head.lower().partition(b"content-length:")[2].split(b"\r\n")[0])
        if len(body) < length:
            return False
        if b"<fault>" in body or not head.startswith((b"HTTP/1.1 200", b"HTTP/1.0 200")):
            raise ConnectionError(f"refused: {self._buffer[:500]!r}")
        self.answer = body
        self.delays.append(time.perf_counter() - self._began)
        if not self._keep:
            self.sock.close()
            self.sock = None
        return True


def load(port: int, operation: str, clients: int, keep: bool, seconds: float) -> tuple[float, float]:
    # Each client is a separate host: a long load of one host would exceed its quota of the audit log and be delayed.
    group = [
        Client(port, requests(operation, one, keep), keep, f"127.0.0.{one + 1}") for one in range(clients)
    ]
    poll = select.epoll()
    waiting: dict[int, Client] = {}

    def go(client: Client) -> None:
        sock = client.send()
        waiting[sock.fileno()] = client
        with suppress(FileExistsError):
            poll.register(sock, select.EPOLLIN)

    began = time.perf_counter()
    for client in group:
        go(client)
    while waiting:
        for descriptor, _events in poll.poll(30.0):
            client = waiting[descriptor]
            if client.receive():
                del waiting[descriptor]
                if time.perf_counter() - began < seconds:
                    go(client)
    taken = time.perf_counter() - began
    for client in group:
        if client.sock is not None:
            client.sock.close()
    delays = [delay for client in group for delay in client.delays]
    return len(delays) / taken, statistics.median(delays) * 1e6


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def await_port(port: int) -> None:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        select.select([], [], [], 0.05)
    raise TimeoutError(f"no process listens on port {port}")


def processor_seconds(pids: list[int]) -> float:
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def await_rest(pids: list[int]) -> None:
    deadline, before = time.monotonic() + 30, -1.0
    while time.monotonic() < deadline and (used := processor_seconds(pids)) != before:
        before = used
        select.select([], [], [], 0.5)


def descendants(pid: int) -> list[int]:
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text(encoding="utf-8").split():
            found += descendants(int(child))
    return found


class Master(NamedTuple):
    port: int
    pids: list[int]

    def under(self, operation: str, clients: int, keep: bool, seconds: float) -> tuple[float, float, float]:
        """Return calls per second, and the median delay and the processor time of a call in microseconds."""
        before = processor_seconds(self.pids)
        began = time.perf_counter()
        rate, delay = load(self.port, operation, clients, keep, seconds)
        used = processor_seconds(self.pids) - before
        return rate, delay, used / (rate * (time.perf_counter() - began)) * 1e6


def measure(plain: Master, ours: Master, seconds: float, rounds: int, only: str) -> Table:
    columns = ("call", "clients", "connections", "rosmaster calls/s", "RVMaster calls/s", "ratio", "added µs")
    table = Table(*columns, "processor µs")
    for operation in OPERATIONS:
        if only not in operation:
            continue
        for clients, keep in LOADS:
            runs = [
                (
                    plain.under(operation, clients, keep, seconds),
                    ours.under(operation, clients, keep, seconds),
                )
                for _ in range(rounds)
            ]
            (rate, delay, used), (our_rate, our_delay, our_used) = (
                [statistics.median(values) for values in zip(*side, strict=True)]
                for side in zip(*runs, strict=True)
            )
            table.add_row(
                operation,
                str(clients),
                "kept" if keep else "new",
                f"{rate:,.0f}",
                f"{our_rate:,.0f}",
                f"{statistics.median(b[0] / a[0] for a, b in runs):.2f}",
                f"{our_delay - delay:+,.0f}",
                f"{used:,.0f} / {our_used:,.0f}",
            )
    return table


@contextmanager
def masters() -> Iterator[tuple[Master, Master]]:
    port = free_port()
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        policy = Path(folder, "bench.ini")
        policy.write_text(POLICY)
        policy.chmod(0o644)
        environment = {**os.environ, "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": folder, "HOME": folder}
        rosmaster = subprocess.Popen(
            ["/usr/bin/rosmaster", "--core", "-p", str(port)], env=environment, stdout=subprocess.DEVNULL
        )
        command: list[str | Path] = [Path(sys.executable).with_name("rosrv"), "up", "--policy", policy]
        command += ["--state", f"{folder}/state", "--listen", "127.0.0.1:0", "--rosmaster-port", "0"]
        appliance = subprocess.Popen(
            [*command, "--isolation", "none", "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            assert appliance.stdout is not None
            ready = json.loads(appliance.stdout.readline())
            await_port(port)
            await_rest(descendants(appliance.pid))
            yield (
                Master(port, [rosmaster.pid]),
                Master(int(ready["master"].rpartition(":")[2]), descendants(appliance.pid)),
            )
        finally:
            for process in (appliance, rosmaster):
                process.terminate()
            for process in (appliance, rosmaster):
                process.wait(15)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", default="", help="calls that have this in their name")
    given = parser.parse_args()
    with masters() as (plain, ours):
        furnish(plain.port)
        furnish(ours.port)
        table = measure(plain, ours, given.seconds, given.rounds, given.only)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
