"""RVMaster beside plain `rosmaster`: `python -m benchmarks.control_plane [--seconds 3] [--rounds 3]`.

Both run at once; in every round they take turns at every load, so that whatever else the machine does falls on both.
Cells are medians of the rounds; the ratio is the median of the rounds' ratios, `added` the difference of the medians
of the delay of one call. The load is one process with one loop: it sends requests that were built before and reads
answers by their length, so it costs little beside what it measures.
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
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

POLICY = """
[Groups]
here = 127.0.0.1
[Nodes]
default = here
[Publishers]
default = here
[Subscribers]
default = here
[Commands]
default = here
"""
OPERATIONS = ("getSystemState", "register/unregister", "setParam/getParam", "multicall of 20")
LOADS = ((1, True), (1, False), (16, True), (16, False))


def request(method: str, *params: Any, keep: bool) -> bytes:
    """One whole HTTP request."""
    body = xmlrpc.client.dumps(params, method).encode()
    connection = "keep-alive" if keep else "close"
    head = f"POST / HTTP/1.1\r\nHost: x\r\nConnection: {connection}\r\nContent-Type: text/xml\r\n"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def requests(operation: str, client: int, keep: bool) -> list[bytes]:
    """What one client sends, over and over."""
    me, api = f"/bench_{client}", f"http://127.0.0.1:{40000 + client}/"
    topic, key = f"/bench/topic_{client}", f"/bench/key_{client}"
    if operation == "getSystemState":
        return [request("getSystemState", me, keep=keep)]
    if operation == "register/unregister":
        return [
            request("registerPublisher", me, topic, "std_msgs/String", api, keep=keep),
            request("unregisterPublisher", me, topic, api, keep=keep),
        ]
    if operation == "setParam/getParam":
        return [request("setParam", me, key, 42, keep=keep), request("getParam", me, key, keep=keep)]
    parts = [{"methodName": "setParam", "params": [me, f"{key}_{one}", one]} for one in range(20)]
    return [request("system.multicall", parts, keep=keep)]


class Client:
    """One connection at a time, one request at a time; `delays` are seconds per call."""

    def __init__(self, port: int, wanted: list[bytes], keep: bool) -> None:
        self.delays: list[float] = []
        self._port, self._wanted, self._keep = port, wanted, keep
        self._next = 0
        self._buffer = b""
        self.sock: socket.socket | None = None

    def send(self) -> socket.socket:
        """Send the next request, on a new connection where there is none."""
        self._began = time.perf_counter()
        if self.sock is None:
            self.sock = socket.create_connection(("127.0.0.1", self._port))
            self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.sendall(self._wanted[self._next % len(self._wanted)])
        self._next += 1
        self._buffer = b""
        return self.sock

    def receive(self) -> bool:
        """Read what is there; whether the answer is whole. Raises ConnectionError for a refusal."""
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
        self.delays.append(time.perf_counter() - self._began)
        if not self._keep:
            self.sock.close()
            self.sock = None
        return True


def load(port: int, operation: str, clients: int, keep: bool, seconds: float) -> tuple[float, float]:
    """Calls per second and the median delay of a call in microseconds."""
    group = [Client(port, requests(operation, one, keep), keep) for one in range(clients)]
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
    """A port that is free now."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def await_port(port: int) -> None:
    """Wait until somebody listens, at most 30 seconds."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        select.select([], [], [], 0.05)
    raise TimeoutError(f"nobody listens on port {port}")


def measure(rosmaster: int, rvmaster: int, seconds: float, rounds: int) -> Table:
    """The table of all operations under all loads."""
    table = Table(
        "call", "clients", "connections", "rosmaster calls/s", "RVMaster calls/s", "ratio", "added µs"
    )
    for operation in OPERATIONS:
        for clients, keep in LOADS:
            plain, ours = [], []
            for _ in range(rounds):
                plain.append(load(rosmaster, operation, clients, keep, seconds))
                ours.append(load(rvmaster, operation, clients, keep, seconds))
            ratio = statistics.median(b[0] / a[0] for a, b in zip(plain, ours, strict=True))
            added = statistics.median(one[1] for one in ours) - statistics.median(one[1] for one in plain)
            table.add_row(
                operation,
                str(clients),
                "kept" if keep else "new",
                f"{statistics.median(one[0] for one in plain):,.0f}",
                f"{statistics.median(one[0] for one in ours):,.0f}",
                f"{ratio:.2f}",
                f"{added:+,.0f}",
            )
    return table


def main() -> None:
    """Run both masters and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
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
        command: list[str | Path] = [
            "up",
            "--policy",
            policy,
            "--state",
            f"{folder}/state",
            "--listen",
            "127.0.0.1:0",
        ]
        appliance = subprocess.Popen(
            [
                Path(sys.executable).with_name("rosrv"),
                *command,
                "--rosmaster-port",
                "0",
                "--isolation",
                "none",
                "--json",
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert appliance.stdout is not None
            ready = json.loads(appliance.stdout.readline())
            await_port(port)
            table = measure(port, int(ready["master"].rpartition(":")[2]), given.seconds, given.rounds)
        finally:
            for process in (appliance, rosmaster):
                process.terminate()
            for process in (appliance, rosmaster):
                process.wait(15)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
