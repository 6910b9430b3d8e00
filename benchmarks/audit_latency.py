"""The cost of the audit log to a caller of RVMaster: python -m benchmarks.audit_latency [--seconds 2] [--rounds 3]

Three appliances take turns: `batched` (the default), `strict` (on disk before the answer), and `batched` with
forwarding to a syslog receiver that takes everything. Each caller makes one call (`hasParam`) after the other on its
own connection. Cells are medians of the rounds in microseconds; CPU is control's processor time for one call.
"""

import argparse
import contextlib
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.control_plane import POLICY, request
from benchmarks.syslog_sink import Sink

_TICKS = os.sysconf("SC_CLK_TCK")


class Running:
    def __init__(self, folder: Path, name: str, audit: dict[str, object]) -> None:
        self.name = name
        home = folder / name
        home.mkdir(mode=0o755)
        config = home / "appliance.yaml"
        config.write_text(json.dumps({"audit": audit}))
        policy = home / "policy.ini"
        policy.write_text(POLICY)
        rosrv = Path(sys.executable).with_name("rosrv")
        command: list[str | Path] = [
            rosrv, "up", "--json", "--config", config, "--policy", policy, "--state", home / "state", "--listen",
            "127.0.0.1:0", "--rosmaster-port", "0", "--isolation", "none", "--api", "off",
        ]  # fmt: skip
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert self._process.stdout is not None
        ready = json.loads(self._process.stdout.readline())
        self.port = int(ready["master"].rpartition(":")[2])
        done = subprocess.run(
            [rosrv, "status", "--json", "--state", home / "state"], capture_output=True, check=False
        )
        processes = json.loads(done.stdout)["processes"]
        self._control = next(one["pid"] for one in processes if one["role"] == "control")

    def cpu(self) -> float:
        fields = Path(f"/proc/{self._control}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(20)


def calls(port: int, seconds: float, taken: list[float]) -> None:
    data = request("hasParam", "/bench", "/run_id", keep=True)
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        length, end = 0, time.perf_counter() + seconds
        while (start := time.perf_counter()) < end:
            connection.sendall(data)
            received = connection.recv(65_536)
            length = length or _length(received)
            while len(received) < length:
                received += connection.recv(65_536)
            taken.append(time.perf_counter() - start)


def _length(answer: bytes) -> int:
    head, _, _ = answer.partition(b"\r\n\r\n")
    fields = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:])
    return len(head) + 4 + int(fields[b"content-length"])


def measure(one: Running, clients: int, seconds: float) -> tuple[float, float, float, float]:
    """Return the median and 99th percentile in microseconds, the calls a second, and control's CPU time of a call."""
    taken: list[list[float]] = [[] for _ in range(clients)]
    threads = [threading.Thread(target=calls, args=(one.port, seconds, mine)) for mine in taken]
    before = one.cpu()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    times = sorted(value for mine in taken for value in mine)
    used = (one.cpu() - before) / len(times)
    return times[len(times) // 2] * 1e6, times[int(len(times) * 0.99)] * 1e6, len(times) / seconds, used * 1e6


@contextlib.contextmanager
def appliances(folder: Path, sink: Sink) -> Iterator[list[Running]]:
    forwarding = {"syslog": {"to": f"tcp://127.0.0.1:{sink.port}"}}
    wanted: dict[str, dict[str, object]] = {
        "batched": {"durability": "batched"},
        "strict": {"durability": "strict"},
        "batched, forwarded": {"durability": "batched", **forwarding},
    }
    running: list[Running] = []
    try:
        for name, audit in wanted.items():
            running.append(Running(folder, name.replace(", ", "-"), audit))
        yield running
    finally:
        for one in running:
            one.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    table = Table("audit", "callers", "median µs", "99 % µs", "calls/s", "CPU of control µs")
    with Sink() as sink, tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        with appliances(Path(name), sink) as running:
            for clients in (1, 16):
                rounds = [
                    [measure(one, clients, given.seconds) for one in running] for _ in range(given.rounds)
                ]
                for place, one in enumerate(running):
                    cells = [
                        statistics.median(values)
                        for values in zip(*(each[place] for each in rounds), strict=True)
                    ]
                    table.add_row(one.name, str(clients), *(f"{cell:,.0f}" for cell in cells))
    Console(width=110).print(table)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; forwarded {sink.messages:,} messages")


if __name__ == "__main__":
    main()
