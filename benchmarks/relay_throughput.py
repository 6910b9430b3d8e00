"""The relay beside `topic_tools relay` and a direct connection: `python -m benchmarks.relay_throughput`.

`relay_load.cpp` is the load, on one topic over the loopback. *window* keeps 64 messages on their way, *flat* sends as
fast as possible and shows the loss, *paced* sends 1,000 messages a second and shows the delay. Systems take turns.
Cells are medians of the rounds, and ratios are to `topic_tools` in the same round. *recorded* is the relay with a
flight recorder's memory of 64 MiB.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import threading
import xmlrpc.client
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from xmlrpc.server import SimpleXMLRPCServer

from appliance.channel.messages import (
    GrantInstalled,
    NodePlaced,
    PublicationPlaced,
    SpecificationsRefused,
    SpecificationsTaken,
    UpstreamFound,
    UpstreamWanted,
)
from appliance.features.recorder.rings import RecorderRings
from appliance.features.recorder.settings import RecorderRules
from tests.support.relay_driver import LOOPBACK, ChannelPeer, RelayProcess, call, free_port
from tests.support.stated import stated
from tests.support.waiting import eventually

HERE = Path(__file__).parent
PROGRAM = HERE.parent / "build" / "benchmarks" / "relay_load"
TOPIC_TOOLS = "/usr/lib/topic_tools/relay"
SIZES = (32, 200, 4096, 65536, 1048576)
MODES = ("window", "flat", "paced")
TYPE = "relay_load/Sample"


@dataclass
class Result:
    """Messages a second, lost ones (fraction and number), delays and the middle's CPU a message (microseconds)."""

    rate: float
    loss: float
    lost: int
    p50: float
    p99: float
    cpu: float


def compiled() -> Path:
    source = HERE / "relay_load.cpp"
    if not PROGRAM.exists() or PROGRAM.stat().st_mtime < source.stat().st_mtime:
        PROGRAM.parent.mkdir(parents=True, exist_ok=True)
        command = ["g++", "-std=c++17", "-O2", "-o", str(PROGRAM), str(source), "-pthread"]
        subprocess.run(command, check=True)
    return PROGRAM


def cpu_seconds(pid: int | None) -> float:
    if pid is None:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(
    mode: str, size: int, seconds: float, system: "System", *md5sum: str, prefix: Sequence[str] = ()
) -> Result:
    """Run the load once. `prefix` begins its command; `md5sum` replaces the md5sum of the message type.

    Sessions share the cores equally (`sched_autogroup_enabled`), so the load has its own, like a node of roslaunch.
    """
    with subprocess.Popen(
        [*prefix, str(compiled()), str(size), str(seconds), mode, *md5sum],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as load:
        assert load.stdin is not None
        assert load.stdout is not None
        port, topic = system.target(int(load.stdout.readline()))
        load.stdin.write(f"{port} {topic} {system.pid or 0}\n")
        load.stdin.close()
        answer = json.loads(load.stdout.read())
    received = answer["sent"] - answer["lost"]
    return Result(
        answer["messages_per_s"],
        answer["lost"] / max(1, answer["sent"]),
        answer["lost"],
        answer["p50_us"],
        answer["p99_us"],
        answer["cpu_us"] / max(1, received),
    )


class System(Protocol):
    name: str
    pid: int | None

    def target(self, publisher: int) -> tuple[int, str]:
        """Return the port and topic for the subscriber."""

    def close(self) -> None: ...


class Direct:
    name = "direct"
    pid: int | None = None

    def target(self, publisher: int) -> tuple[int, str]:
        return publisher, "-"

    def close(self) -> None: ...


class Relay:
    """This project's relay process, with this benchmark as its control."""

    def __init__(self, name: str = "relay", *, recorded: bool = False) -> None:
        self.name = name
        self._publishers: dict[str, int] = {}
        self._relay = RelayProcess()
        if recorded:
            rings = RecorderRings(RecorderRules(), 1)
            [(given, memory)] = rings.messages_for("relay", 0)
            self._relay.lifeline.send(given, (memory,))
            rings.close()
        self._link: ChannelPeer = self._relay.open_link(self._answer)
        self.pid: int | None = self._relay.process.pid

    def monitor(self, files: list[tuple[str, str]], definitions: dict[str, str]) -> None:
        self._link.send(stated(1, files, definitions, {}, restarted=False))
        answer = self._link.wait_for(lambda one: isinstance(one, SpecificationsTaken | SpecificationsRefused))
        if isinstance(answer, SpecificationsRefused):
            raise SystemExit(f"the relay does not take the specifications: {answer.findings}")

    def target(self, publisher: int) -> tuple[int, str]:
        return self.place(publisher, "/load")

    def place(self, publisher: int, topic: str) -> tuple[int, str]:
        key = str(len(self._publishers) + 1)
        self._publishers[key] = publisher
        with socket.create_server((LOOPBACK, 0)) as listening:
            self._link.send(NodePlaced(key, "/load", LOOPBACK), (listening.fileno(),))
            self._link.send(PublicationPlaced(key, topic, TYPE))
            self._link.send(GrantInstalled(key, topic, LOOPBACK, "/load_listener"))
            self._relay.ping(len(self._publishers))
            return int(listening.getsockname()[1]), topic

    def close(self) -> None:
        self._relay.stop()
        self._link.close()

    def _answer(self, message: Any) -> None:
        if isinstance(message, UpstreamWanted):
            self._link.send(
                UpstreamFound(message.key, message.topic, LOOPBACK, self._publishers[message.key])
            )


class LoadApi:
    def __init__(self) -> None:
        self.publisher = 0
        self._server = SimpleXMLRPCServer((LOOPBACK, 0), logRequests=False)
        self._server.register_instance(self)
        self.uri = f"http://{LOOPBACK}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _dispatch(self, method: str, _parameters: tuple[Any, ...]) -> Any:
        if method == "requestTopic":
            return [1, "", ["TCPROS", LOOPBACK, self.publisher]]
        return [1, "", 0]


class RosRelay:
    """A relay that is a ROS node, behind a plain master. The node is started again for each run."""

    def __init__(self, name: str = "topic_tools", command: Sequence[str] = (TOPIC_TOOLS,)) -> None:
        self.name = name
        self._command = command
        port = free_port()
        self._uri = f"http://{LOOPBACK}:{port}/"
        self._environment = {**os.environ, "ROS_MASTER_URI": self._uri, "ROS_IP": LOOPBACK}
        self._master = subprocess.Popen(
            ["rosmaster", "--core", "-p", str(port)],
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        eventually(self._answers, "rosmaster answers")
        self._api = LoadApi()
        self._runs = 0
        self._relay: subprocess.Popen[bytes] | None = None
        self.pid: int | None = None

    def target(self, publisher: int) -> tuple[int, str]:
        self.stop_relay()
        self._api.publisher = publisher
        self._runs += 1
        given, taken = f"/in{self._runs}", f"/out{self._runs}"
        call(self._uri, "registerPublisher", "/load", given, TYPE, self._api.uri)
        self._relay = subprocess.Popen(
            [*self._command, given, taken, f"__name:=relay{self._runs}"],
            env=self._environment,
            stdout=subprocess.DEVNULL,
        )
        self.pid = self._relay.pid
        found: list[str] = []

        def published() -> bool:
            _code, _text, (publishers, _subscribers, _services) = call(self._uri, "getSystemState", "/load")
            found[:] = [node for topic, nodes in publishers if topic == taken for node in nodes]
            return bool(found)

        eventually(published, f"{self.name} publishes")
        uri = call(self._uri, "lookupNode", "/load", found[0])[2]
        return int(call(uri, "requestTopic", "/load_listener", taken, [["TCPROS"]])[2][2]), taken

    def stop_relay(self) -> None:
        if self._relay is not None:
            self._relay.terminate()
            self._relay.wait(10)

    def close(self) -> None:
        self.stop_relay()
        self._api.close()
        self._master.terminate()
        self._master.wait(10)

    def _answers(self) -> bool:
        try:
            return bool(call(self._uri, "getUri", "/load")[0] == 1)
        except (OSError, xmlrpc.client.Error):
            return False


def table(
    results: dict[tuple[str, int, str], list[Result]], mode: str, sizes: list[int], names: list[str]
) -> None:
    print(f"\n{mode}: " + ("p50 in microseconds" if mode == "paced" else "messages a second"))
    print("x: ratio to topic_tools; in brackets: CPU microseconds a message of what is in the middle")
    print(f"{'':<12}" + "".join(f"{size:>30,}" for size in sizes))
    for name in names:
        cells = []
        for size in sizes:
            runs = results[mode, size, name]
            base = results[mode, size, "topic_tools"]

            def value(result: Result) -> float:
                return result.p50 if mode == "paced" else result.rate

            ratio = statistics.median(
                value(one) / value(other) if value(other) else float("nan")
                for one, other in zip(runs, base, strict=True)
            )
            loss = statistics.median(one.loss for one in runs)
            text = f"{statistics.median(map(value, runs)):,.0f} x{ratio:.2f}"
            cpu = statistics.median(one.cpu for one in runs)
            text += f" lost {loss:.0%}" if loss else ""
            text += f" ({cpu:.2f})" if cpu else ""
            cells.append(f"{text:>30}")
        print(f"{name:<12}" + "".join(cells))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1.5)
    parser.add_argument(
        "--sizes", type=lambda text: [int(one) for one in text.split(",")], default=list(SIZES)
    )
    parser.add_argument("--modes", type=lambda text: text.split(","), default=list(MODES))
    options = parser.parse_args()
    results: dict[tuple[str, int, str], list[Result]] = {}
    systems: list[System] = [Direct(), Relay(), Relay("recorded", recorded=True), RosRelay()]
    try:
        for _round in range(options.rounds):
            for mode in options.modes:
                for size in options.sizes:
                    for system in systems:
                        result = run(mode, size, options.seconds, system)
                        results.setdefault((mode, size, system.name), []).append(result)
    finally:
        for system in systems:
            system.close()
    for mode in options.modes:
        table(results, mode, options.sizes, [system.name for system in systems])


if __name__ == "__main__":
    main()
