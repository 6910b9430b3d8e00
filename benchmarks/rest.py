"""REST beside a bare FastAPI route on uvicorn: `python -m benchmarks.rest [--seconds 2] [--rounds 3]`.

Both run at the same time and take turns at every load. Requests a second are medians of the rounds, and ratios
medians of the rounds' ratios. The CPU time of a request includes the api and control. A second table has the delay of
a call of RVMaster while REST is at full load, and in a quiet second of the same round.
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
import threading
import time
import urllib.parse
import xmlrpc.client
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

POLICY = (
    "[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n[Subscribers]\ndefault = *\n[Commands]\ndefault = *\n"
)
CONFIG = "api: 127.0.0.1:0\napi_tls: {tls}\napi_limits: {{requests_per_second: 1000000, burst: 1000000}}\n"
BARE = """
import sys, uvicorn
from fastapi import FastAPI
app = FastAPI()
@app.get("/bare")
async def bare() -> dict[str, str]:
    return {"status": "live"}
uvicorn.run(app, port=int(sys.argv[1]), log_level="error", access_log=False, loop="uvloop", http="httptools")
"""
PATHS = (
    "/healthz", "/v1/whoami", "/v1/status", "/v1/policy", "/v1/monitors", "/v1/graph",
    "/v1/audit?limit=50", "/v1/audit?decision=deny&limit=50", "/metrics",
)  # fmt: skip
CLIENTS = (1, 16)
NODES, TOPICS = 50, 4


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Client:
    def __init__(self, port: int, data: bytes) -> None:
        self.sock = socket.create_connection(("127.0.0.1", port))
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.data = data
        self.got = b""
        self.done = 0

    def send(self) -> None:
        self.got = b""
        self.sock.sendall(self.data)

    def receive(self) -> bool:
        piece = self.sock.recv(1 << 20)
        if not piece:
            raise RuntimeError(f"the server closed the connection: {self.got[:300]!r}")
        self.got += piece
        head, separator, body = self.got.partition(b"\r\n\r\n")
        if not separator:
            return False
        if b" 200 " not in head[:16]:
            raise RuntimeError(self.got[:500].decode(errors="replace"))
        length = next(line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        return len(body) >= int(length[15:])


def load(port: int, path: str, token: str, clients: int, seconds: float) -> float:
    head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
    everybody = {one.sock.fileno(): one for one in (Client(port, head) for _ in range(clients))}
    poll = select.epoll()
    for number in everybody:
        poll.register(number, select.EPOLLIN)
    for one in everybody.values():
        one.send()
    began = time.perf_counter()
    while (now := time.perf_counter()) - began < seconds:
        for number, _event in poll.poll(1):
            one = everybody[number]
            if one.receive():
                one.done += 1
                one.send()
    poll.close()
    for one in everybody.values():
        one.sock.close()
    return sum(one.done for one in everybody.values()) / (now - began)


def cpu(pids: list[int]) -> float:
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


class Appliance:
    def __init__(self, home: Path) -> None:
        home.chmod(0o755)
        (home / "policy.ini").write_text(POLICY)
        (home / "appliance.yaml").write_text(CONFIG.format(tls="off"))
        command = [
            str(Path(sys.executable).parent / "rosrv"), "up", "--json", "--isolation", "none",
            "--state", str(home / "state"), "--policy", str(home / "policy.ini"),
            "--config", str(home / "appliance.yaml"), "--listen", "127.0.0.1:0", "--rosmaster-port", "0",
        ]  # fmt: skip
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self.process.stdout is not None
        ready = json.loads(self.process.stdout.readline())
        self.master, self.token = str(ready["master"]), str(ready["token"])
        self.port = int(urllib.parse.urlsplit(ready["api"]).port or 0)
        with xmlrpc.client.ServerProxy(self.master) as master:
            for number in range(NODES):
                for topic in range(TOPICS):
                    master.registerPublisher(
                        f"/node{number}",
                        f"/t{number}/{topic}",
                        "std_msgs/String",
                        f"http://127.0.0.1:{20_000 + number}/",
                    )
        rows = self.status()["processes"]
        self.pids = [int(row["pid"]) for row in rows if row["role"] in ("api", "control")]

    def status(self) -> dict[str, Any]:
        client = Client(
            self.port,
            f"GET /v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {self.token}\r\n\r\n".encode(),
        )
        client.send()
        while not client.receive():
            pass
        client.sock.close()
        found: dict[str, Any] = json.loads(client.got.partition(b"\r\n\r\n")[2])
        return found

    def delays(self, seconds: float) -> list[float]:
        """Return the seconds of getSystemState calls, one after the other."""
        found = []
        with xmlrpc.client.ServerProxy(self.master) as master:
            end = time.perf_counter() + seconds
            while (began := time.perf_counter()) < end:
                master.getSystemState("/bench")
                found.append(time.perf_counter() - began)
        return found

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(len(values) * share))]


def rates(appliance: Appliance, bare: int, seconds: float, rounds: int) -> list[dict[str, Any]]:
    rows = []
    for clients in CLIENTS:
        for path in PATHS:
            ours, theirs, costs = [], [], []
            for _ in range(rounds):
                theirs.append(load(bare, "/bare", "", clients, seconds))
                before = cpu(appliance.pids)
                ours.append(load(appliance.port, path, appliance.token, clients, seconds))
                costs.append((cpu(appliance.pids) - before) / (ours[-1] * seconds))
            ratio = statistics.median(our / their for our, their in zip(ours, theirs, strict=True))
            rows.append(
                {
                    "path": path, "clients": clients, "per_second": round(statistics.median(ours)),
                    "bare_per_second": round(statistics.median(theirs)), "ratio": round(ratio, 3),
                    "cpu_ms": round(1000 * statistics.median(costs), 3),
                }
            )  # fmt: skip
    return rows


def effects(appliance: Appliance, seconds: float, rounds: int) -> list[dict[str, Any]]:
    rows = []
    for path in ("/healthz", "/v1/status", "/v1/graph", "/v1/audit?limit=50"):
        quiet, loaded = [], []
        for _ in range(rounds):
            quiet += appliance.delays(seconds)
            loaded += beside(
                partial(load, appliance.port, path, appliance.token, 16, seconds + 0.5),
                lambda: appliance.delays(seconds),
            )
        rows.append(
            {
                "beside": path,
                "quiet_p50_ms": round(1000 * quantile(quiet, 0.5), 3), "p50_ms": round(1000 * quantile(loaded, 0.5), 3),
                "quiet_p99_ms": round(1000 * quantile(quiet, 0.99), 3),
                "p99_ms": round(1000 * quantile(loaded, 0.99), 3),
            }
        )  # fmt: skip
    return rows


def beside(work: Callable[[], Any], measured: Callable[[], list[float]]) -> list[float]:
    thread = threading.Thread(target=work)
    thread.start()
    found = measured()
    thread.join()
    return found


def show(title: str, rows: list[dict[str, Any]]) -> None:
    table = Table(*rows[0], title=title, box=None, padding=(0, 2, 0, 0), title_justify="left")
    for row in rows:
        table.add_row(*map(str, row.values()))
    Console(width=120, highlight=False).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    bare = free_port()
    with tempfile.TemporaryDirectory(prefix="rosrv-bench-") as home:
        program = subprocess.Popen([sys.executable, "-c", BARE, str(bare)])
        appliance = Appliance(Path(home))
        try:
            wait_for(bare)
            found = {
                "rates": rates(appliance, bare, arguments.seconds, arguments.rounds),
                "effects": effects(appliance, arguments.seconds, arguments.rounds),
            }
        finally:
            program.terminate()
            program.wait()
            appliance.stop()
    if arguments.json:
        print(json.dumps(found))
        return
    show("Requests a second", found["rates"])
    show("A call of RVMaster (getSystemState) with REST at full load (16 clients)", found["effects"])


def wait_for(port: int) -> None:
    end = time.monotonic() + 30
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            if time.monotonic() > end:
                raise


if __name__ == "__main__":
    main()
