"""The flight recorder beside `rosbag record` and `rosbag_snapshot`: `python -m benchmarks.recorder [--seconds 15]`.

One node talks on fifty topics (20 MB/s in total) or on five (0.1 MB/s), and another listens. The systems take turns:
a plain master; the same with `rosbag record -a`; the same with the node `snapshot` (the program given by
`--snapshot`, in PATH or below /opt/ros); the appliance without and with the recorder. The columns are messages, those
missing between the first and the last of a topic, the seconds from the end of the recorded time until the file is
complete, processor time in percent of a core, and the median delay. In the row *killed*, relay, control and recorder
get SIGKILL together, and a message that the subscriber received in the recorded time is missing if the recording
lacks it.
"""

import argparse
import json
import os
import shutil
import signal
import statistics
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table
from rosbags.rosbag1 import Reader

from benchmarks.relay_throughput import cpu_seconds
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import ROOT, RosSession
from tests.support.rosmaster import PlainMaster
from tests.support.waiting import eventually

LOADS = {"fifty topics, 20 MB/s": (50, 8192, 50), "five topics, 0.1 MB/s": (5, 1024, 20)}
_SOURCE = Path(__file__).parent / "nodes" / "recorder_load.cpp"
_PROGRAM = ROOT / "build" / "benchmarks" / "recorder_load"
_HEAD = struct.Struct("<4xQ")  # in a std_msgs/String: its length, the number
_WARM_SECONDS, _AFTER_SECONDS = 3.0, 5.0
_CONFIGURATION = """
recorder: {{enabled: {enabled}, memory: 512MiB, before: {seconds}, disk: 8GiB, triggers: []}}
audit: {{reserve_bytes: 1MiB}}
"""


class Bag(NamedTuple):
    messages: int
    lost: int
    closed: float


@dataclass
class Result:
    """A run. `cpu` has the percentage of a core by the name of the process."""

    p50: float
    bag: Bag | None = None
    cpu: dict[str, float] = field(default_factory=dict)


class Load:
    """Two connected nodes. The listener writes the messages that it receives to a file in `folder`."""

    def __init__(self, session: RosSession, folder: Path, topics: int, size: int, hertz: int) -> None:
        self._heard = folder / "heard"
        self._talker = session.start(
            [str(_PROGRAM), "talk", str(topics), str(size), str(hertz)], label="talker"
        )
        self._talker.wait_for(event="ready")
        self._listener = session.start(
            [str(_PROGRAM), "listen", str(topics), str(self._heard)], label="listener"
        )
        self._listener.wait_for(event="ready")
        self.last(_WARM_SECONDS)

    def last(self, seconds: float) -> None:
        try:
            self._listener.popen.wait(seconds)
        except subprocess.TimeoutExpired:
            return
        raise SystemExit(f"the listener ended: {self._listener.story()}")

    def end(self) -> float:
        self._listener.interrupt()
        heard = self._listener.wait_for(event="heard")
        self._talker.stop()
        return float(heard["p50_us"])

    def heard(self, began: int, ended: int) -> dict[str, set[int]]:
        """Return the numbers of the messages received from `began` to `ended` (ns), by topic.

        The first second is left out, because its messages may have been published before.
        """
        numbers: dict[str, set[int]] = {}
        for topic, number, when in struct.iter_unpack("=QQQ", self._heard.read_bytes()):
            if began + 1e9 < when < ended:
                numbers.setdefault(f"/load/t{topic}", set()).add(number)
        return numbers


@contextmanager
def measured(pids: Mapping[str, int], seconds: float, into: dict[str, float]) -> Iterator[None]:
    before = {name: cpu_seconds(pid) for name, pid in pids.items()}
    yield
    into |= {name: 100 * (cpu_seconds(pid) - before[name]) / seconds for name, pid in pids.items()}


def counted(path: Path, closed: float, heard: dict[str, set[int]] | None = None) -> Bag:
    """Count a bag's messages and its missing ones: gaps of a topic's numbers, or with `heard` those that it lacks."""
    numbers: dict[str, set[int]] = {}
    with Reader(path) as reader:
        for connection, _time, data in reader.messages():
            if connection.topic.startswith("/load/"):
                numbers.setdefault(connection.topic, set()).add(_HEAD.unpack_from(data)[0])
    if heard is None:
        lost = sum(max(seen) - min(seen) + 1 - len(seen) for seen in numbers.values())
    else:
        lost = sum(len(told - numbers.get(topic, set())) for topic, told in heard.items())
    return Bag(sum(map(len, numbers.values())), lost, closed)


def snapshot_program() -> Path | None:
    installed = Path("/").glob("opt/ros/*/lib/rosbag_snapshot/snapshot")
    found = shutil.which("snapshot")
    return next(installed, None) if found is None else Path(found)


def at_plain_master(
    folder: Path, load: tuple[int, int, int], seconds: float, recorder: str, snapshot: Path | None
) -> Result:
    """Measure at a plain master. `recorder` is "", `rosbag`, or `snapshot` for the node of rosbag_snapshot."""
    with PlainMaster(folder) as master, RosSession(master.master_uri, folder) as session:
        running = Load(session, folder, *load)
        if not recorder:
            running.last(seconds)
            return Result(running.end())
        bag, cpu = folder / "rosbag.bag", dict[str, float]()
        if recorder == "rosbag":
            command = ["/usr/lib/rosbag/record", "-a", "-O", str(bag)]
        else:
            names = [f"/load/t{number}" for number in range(load[0])]
            command = [str(snapshot), "-d", str(seconds), "-s", "1000", *names]
        process = session.start(command, label=recorder)
        if recorder == "rosbag":
            eventually(bag.with_suffix(".bag.active").exists, "rosbag records")
        with measured({recorder: process.pid}, seconds, cpu):
            running.last(seconds)
        ended = time.monotonic()
        if recorder == "rosbag":
            process.interrupt(signal.SIGINT)
            process.popen.wait(120)
        else:
            session.run(str(snapshot), "-t", "-O", str(bag), timeout=120)
        closed = time.monotonic() - ended
        return Result(running.end(), counted(bag, closed), cpu)


def at_appliance(
    folder: Path, load: tuple[int, int, int], seconds: float, *, recorder: bool, kills: bool = False
) -> Result:
    configuration = folder / "appliance.yaml"
    configuration.write_text(_CONFIGURATION.format(enabled=str(recorder).lower(), seconds=seconds))
    options = ("--config", str(configuration))
    with (
        Appliance(policy=OPEN_POLICY, options=options) as appliance,
        RosSession(appliance.master_uri, folder) as session,
    ):
        pids = {
            row["role"]: row["pid"]
            for row in appliance.status()["processes"]
            if row["role"] in ("relay", "recorder")
        }
        running, cpu = Load(session, folder, *load), dict[str, float]()
        if not recorder:
            with measured(pids, seconds, cpu):
                running.last(seconds)
            return Result(running.end(), cpu=cpu)
        if kills:
            running.last(seconds / 2)
            for row in appliance.status()["processes"]:
                if row["role"] in ("relay", "control", "recorder"):
                    os.kill(row["pid"], signal.SIGKILL)
            running.last(seconds / 2)
            pids = {}
        with measured(pids, seconds + _AFTER_SECONDS, cpu):
            running.last(0 if kills else seconds)
            order = (
                "record",
                "now",
                "--before",
                f"{seconds:g}s",
                "--after",
                f"{_AFTER_SECONDS:g}s",
                "--json",
            )
            begun = json.loads(appliance.rosrv(*order).stdout)
            bag = appliance.state / "recordings" / begun["id"] / "recording.bag"
            eventually(bag.exists, appliance.story, 120)
            closed = time.time() - begun["ends"] / 1e9
        p50 = running.end()
        [row] = map(json.loads, appliance.rosrv("record", "list", "--json").stdout.splitlines())
        heard = running.heard(row["began"], row["ended"]) if kills else None
        return Result(p50, counted(bag, closed, heard), cpu)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=15, help="that are recorded")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument(
        "--snapshot", type=Path, default=snapshot_program(), help="the node of rosbag_snapshot"
    )
    given = parser.parse_args()
    if given.snapshot is not None and not os.access(given.snapshot, os.X_OK):
        parser.error(f"{given.snapshot} is not a program")
    subprocess.run([str(ROOT / "scripts" / "build-roscpp"), str(_SOURCE), str(_PROGRAM)], check=True)
    snapshot = ["snapshot"] if given.snapshot is not None else []
    for title, load in LOADS.items():
        results: dict[str, list[Result]] = {}
        for _round in range(given.rounds):
            for name in ("plain", "rosbag", *snapshot, "appliance", "recorder", "killed"):
                with tempfile.TemporaryDirectory(prefix="rosrv-benchmark-") as place:
                    folder = Path(place)
                    folder.chmod(0o755)  # the appliance's processes run as other users
                    if name in ("appliance", "recorder", "killed"):
                        result = at_appliance(
                            folder,
                            load,
                            given.seconds,
                            recorder=name != "appliance",
                            kills=name == "killed",
                        )
                    else:
                        recorder = name if name != "plain" else ""
                        result = at_plain_master(folder, load, given.seconds, recorder, given.snapshot)
                results.setdefault(name, []).append(result)
        show(title, results)
    if not snapshot:
        Console().print("rosbag_snapshot is not on this machine (--snapshot PROGRAM): no row for it")
    Console().print(f"load average of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def show(title: str, results: Mapping[str, list[Result]]) -> None:
    table = Table("", "messages", "lost", "file after s", "percent of a core", "p50 µs", title=title)
    for name, runs in results.items():
        bags = [run.bag for run in runs if run.bag is not None]
        cells = [
            f"{statistics.median(bag[place] for bag in bags):,.{digits}f}" if bags else "-"
            for place, digits in ((0, 0), (1, 0), (2, 1))
        ]
        cpu = ", ".join(
            f"{role} {statistics.median(run.cpu[role] for run in runs):.0f}" for role in runs[0].cpu
        )
        table.add_row(name, *cells, cpu or "-", f"{statistics.median(run.p50 for run in runs):,.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
