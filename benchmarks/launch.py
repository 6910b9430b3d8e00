"""Launch a robot beside plain `rosmaster`: python -m benchmarks.launch [--nodes 40] [--rounds 8] [--rospy] [--busy]
[--again 20]

`roslaunch` starts nodes. Each reads 20 private parameters, publishes five topics, subscribes to five of the next
node, and is up when all five bring messages. Both masters are new in each round and take turns: `rosmaster` with
`rosout`, and a running appliance. The rows are

- the time until the last node is up, and the processor time of the master's processes until then;
- the delays of `getParam` and `registerPublisher` calls that another client makes on new connections, every 20 ms
  during the start;
- the time until a killed node works again, and the time of three tools.

Figures are medians of the rounds. A ratio is the median of the rounds' ratios, above 1 where the appliance is slower.
With `--busy`, a program for each processor works half of the time.

The last lines are findings: rows whose ratio is more than 20 % above, or more than 20 % below, the ratio of the same
robot in `benchmarks/RESULTS.md`, in every round and always on the same side. If the true median is within the 20 %, a
round is beyond a limit with a probability of at most one half. So chance makes a row a finding in at most one of 128
measurements of eight rounds.

With `--again 20`, both masters stay, and the robot is started that many times in a row on each of them, by turns: a
start begins when the nodes of the one before have ended. The table has the seconds of each start, and the seconds of
processor time of each master's processes until its last node is up, which other work on the machine hardly changes. The
exit status is 1 if a start fails, if the median of the ratios is above 1.4, or if one of them is above 2.

Needs root. The benchmark runs in its own process namespace, so that the kernel ends everything with it.
"""

import argparse
import contextlib
import math
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import xmlrpc.client
import xmlrpc.server
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.control_plane import descendants, processor_seconds
from tests.support.appliance import Appliance
from tests.support.nodes import BUILD, ROOT, RosSession
from tests.support.rosmaster import PlainMaster, free_port

HERE = Path(__file__).parent / "nodes"
RESULTS = Path(__file__).with_name("RESULTS.md")
LONE = "ordinary priority"  # the column of `benchmarks/cold.py` there
_CONTAINED = (
    "setpriv", "--pdeathsig", "KILL", "unshare", "--pid", "--fork", "--kill-child", "--mount-proc",
    sys.executable, "-m", "benchmarks.launch",
)  # fmt: skip
CHANGE = 1.2  # a ratio that differs from the table by more than this factor is a finding
PARAMETERS = 20
LIMIT = 180.0  # seconds until a start counts as failed
PAUSE = 0.02  # seconds between two calls of the other client
BUSY = """import time
while True:
    end = time.monotonic() + 0.05
    while time.monotonic() < end: pass
    time.sleep(0.05)
"""
MEDIAN, GREATEST = 1.4, 2.0  # the ratios of repeated starts that are still good
TOOLS = (("rostopic", "list"), ("rosnode", "info", "/node_0"), ("rosparam", "dump"))


@dataclass
class Start:
    figures: dict[str, float] = field(default_factory=dict)


class Reports:
    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port = int(self._socket.getsockname()[1])

    def wait(self, numbers: set[int]) -> float:
        """Return the time (monotonic) at which the last of these nodes was up. Raise `TimeoutError`."""
        last, deadline = 0.0, time.monotonic() + LIMIT
        while numbers:
            self._socket.settimeout(max(0.001, deadline - time.monotonic()))
            try:
                number, at = self._socket.recv(64).split()
            except TimeoutError:
                raise TimeoutError(f"not up in {LIMIT:.0f} s: nodes {sorted(numbers)}") from None
            numbers.discard(int(number))
            last = max(last, float(at))
        return last

    def close(self) -> None:
        self._socket.close()


class OtherClient:
    def __init__(self, uri: str) -> None:
        self.delays: dict[str, list[float]] = {"getParam": [], "registerPublisher": []}
        self._uri = uri
        self._over = threading.Event()
        self._node = xmlrpc.server.SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self._node.register_instance(_Node())
        self._threads = [
            threading.Thread(target=self._node.serve_forever),
            threading.Thread(target=self._call),
        ]

    def _call(self) -> None:
        number, own = 0, f"http://127.0.0.1:{self._node.server_address[1]}/"
        while not self._over.wait(PAUSE):
            number += 1
            self._timed("getParam", f"/node_{number % 7}/gain_{number % PARAMETERS}")
            self._timed("registerPublisher", f"/other/t{number}", "std_msgs/String", own)

    def _timed(self, method: str, *params: str) -> None:
        began = time.perf_counter()
        with xmlrpc.client.ServerProxy(self._uri) as master:
            getattr(master, method)("/other", *params)
        self.delays[method].append(time.perf_counter() - began)

    def __enter__(self) -> "OtherClient":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self._threads[1].join()
        self._node.shutdown()
        self._threads[0].join()
        self._node.server_close()


class _Node:
    def _dispatch(self, method: str, _params: object) -> list[object]:
        return [1, "", os.getpid() if method == "getPid" else 0]


def package(folder: Path, nodes: int, port: int, *, rospy: bool) -> Path:
    made = folder / "launched"
    made.mkdir()
    (made / "package.xml").write_text(
        "<package><name>launched</name><version>1.0.0</version><description>launched</description>"
        "<maintainer email='nobody@example.org'>nobody</maintainer><license>BSD</license></package>"
    )
    if rospy:
        shutil.copy(HERE / "launched_node.py", made / "node")
    else:
        BUILD.mkdir(parents=True, exist_ok=True)
        target = BUILD / "launched_node"
        subprocess.run([ROOT / "scripts" / "build-roscpp", HERE / "launched_node.cpp", target], check=True)
        shutil.copy(target, made / "node")
    (made / "node").chmod(0o755)
    gains = "".join(f'<param name="gain_{one}" value="{one}.5"/>' for one in range(PARAMETERS))
    file = folder / "robot.launch"
    file.write_text(
        "<launch>"
        + "".join(
            f'<node pkg="launched" type="node" name="node_{one}" args="{one} {nodes} {port}">{gains}</node>'
            for one in range(nodes)
        )
        + "</launch>"
    )
    return file


def start(session: RosSession, masters: list[int], nodes: int, *, rospy: bool) -> Start:
    """Measure a start. `masters` are the processes of the master, whose descendants count as well."""
    reports, measured = Reports(), Start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = package(folder, nodes, reports.port, rospy=rospy)
        path = {"ROS_PACKAGE_PATH": f"{folder}:/usr/share"}
        used = _used(masters)
        with OtherClient(session.master_uri) as other:
            began = time.monotonic()
            launch = session.start(["/usr/bin/roslaunch", "--disable-title", str(file)], **path)
            last = reports.wait(set(range(nodes)))
        measured.figures["last node is up"] = last - began
        measured.figures["processor time of all processes"] = _used_since(used, masters)
        for method, delays in other.delays.items():
            measured.figures[f"one {method} during the start"] = statistics.median(delays)
        measured.figures["a killed node works again"] = killed(session, folder, reports, nodes, path)
        for tool in TOOLS:
            taken = time.monotonic()
            session.run(*tool)
            measured.figures[" ".join(tool[:2])] = time.monotonic() - taken
        launch.stop(with_signal=signal.SIGINT, timeout=60)
    reports.close()
    return measured


class Launches:
    """A robot that is started again and again with one master, whose processes descend from `masters`."""

    def __init__(
        self, session: RosSession, masters: list[int], folder: Path, nodes: int, *, rospy: bool
    ) -> None:
        self._session, self._masters, self._nodes = session, masters, nodes
        self._reports = Reports()
        self._file = package(folder, nodes, self._reports.port, rospy=rospy)
        self._path = {"ROS_PACKAGE_PATH": f"{folder}:/usr/share"}

    def start(self) -> tuple[float, float]:
        """Start the robot, and end it.

        Return the seconds until its last node is up, or infinity, and the masters' processor seconds until then.
        """
        used, began = _used(self._masters), time.monotonic()
        launch = self._session.start(["/usr/bin/roslaunch", "--disable-title", str(self._file)], **self._path)
        try:
            taken = self._reports.wait(set(range(self._nodes))) - began
            return taken, _used_since(used, self._masters)
        except TimeoutError as error:
            print(f"{error}\n{launch.story()[-2000:]}", file=sys.stderr)
            return math.inf, math.inf
        finally:
            launch.stop(with_signal=signal.SIGINT, timeout=120)


def again(nodes: int, starts: int, *, rospy: bool) -> int:
    """Start a robot `starts` times with each of the masters, by turns; return the exit status."""
    load, table = os.getloadavg()[0], Table("start", "rosmaster", "appliance", "ratio")
    table.add_column("processor time")
    ratios, processor = [], []
    with contextlib.ExitStack() as stack:
        launches = []
        for side in (plain, deployed):
            session, masters = stack.enter_context(side())
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            launches.append(Launches(session, masters, folder, nodes, rospy=rospy))
        for number in range(starts):
            (theirs, their_time), (ours, our_time) = (launch.start() for launch in launches)
            if not math.isfinite(theirs):
                raise TimeoutError(f"start {number + 1}: the plain master's robot is not up: measure again")
            ratios.append(ours / theirs)
            processor.append((their_time, our_time))
            times = f"{their_time:.2f} / {our_time:.2f} s"
            table.add_row(str(number + 1), _seconds(theirs), _seconds(ours), f"{ratios[-1]:.2f}", times)
    median, greatest = statistics.median(ratios), max(ratios)
    kind = "rospy" if rospy else "roscpp"
    print(f"{nodes} {kind} nodes, {starts} starts in a row, load average {load:.1f}")
    Console(width=110).print(table)
    print(f"median ratio {median:.2f} (at most {MEDIAN}), greatest {greatest:.2f} (at most {GREATEST})")
    plain_time, own_time = (statistics.median(times) for times in zip(*processor, strict=True))
    print(f"median processor time: rosmaster {plain_time:.2f} s, appliance {own_time:.2f} s")
    return int(median > MEDIAN or greatest > GREATEST)


def _used(masters: list[int]) -> dict[int, float]:
    pids = {pid for master in masters for pid in descendants(master)}
    return {pid: processor_seconds([pid]) for pid in pids}


def _used_since(used: Mapping[int, float], masters: list[int]) -> float:
    return sum(seconds - used.get(pid, 0.0) for pid, seconds in _used(masters).items())


def killed(session: RosSession, folder: Path, reports: Reports, nodes: int, path: dict[str, str]) -> float:
    """Kill the first node, and return the seconds until it is up again."""
    [found] = [
        int(entry.name)
        for entry in Path("/proc").iterdir()
        if entry.name.isdigit() and _is_first(entry, str(folder))
    ]
    os.kill(found, signal.SIGKILL)
    began = time.monotonic()
    command = [str(folder / "launched" / "node"), "0", str(nodes), str(reports.port), "__name:=node_0"]
    node = session.start(command, **path)
    taken = reports.wait({0}) - began
    node.stop(with_signal=signal.SIGINT)
    return taken


def _is_first(entry: Path, folder: str) -> bool:
    with contextlib.suppress(OSError):
        words = (entry / "cmdline").read_bytes().split(b"\0")
        return b"__name:=node_0" in words and any(word.startswith(folder.encode()) for word in words)
    return False


@contextlib.contextmanager
def plain() -> Iterator[tuple[RosSession, list[int]]]:
    with (
        tempfile.TemporaryDirectory() as home,
        PlainMaster(Path(home)) as master,
        RosSession(master.master_uri, Path(home)) as session,
    ):
        yield session, [process.pid for process in master.processes]


@contextlib.contextmanager
def deployed() -> Iterator[tuple[RosSession, list[int]]]:
    options = ("--api", "off", "--listen", f"127.0.0.1:{free_port()}")
    with Appliance(options=options) as appliance, tempfile.TemporaryDirectory() as home:
        assert appliance.process is not None
        with RosSession(appliance.master_uri, Path(home)) as session:
            yield session, [appliance.process.pid]


def table_ratios(text: str, robot: str) -> dict[str, float]:
    """Return the ratio of each row in the column of this robot, or {} without a column."""
    tables = [part.splitlines() for part in text.split("\n\n") if f"| {robot}, load" in part]
    if not tables:
        return {}
    [lines] = tables
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    [column] = [number for number, title in enumerate(head) if title.startswith(f"{robot}, load")]
    return {
        row[0].replace("`", ""): float(row[column].rpartition(", ")[2]) for row in rows if "," in row[column]
    }


def findings(
    measured: Mapping[str, Sequence[float]], table: Mapping[str, float], peer: str = "plain master's"
) -> list[str]:
    """Return the rows whose ratio is beyond the table's 20 % on the same side in every round, or not in the table."""
    found = []
    for what, ratios in measured.items():
        known = table.get(what)
        if known is None:
            found.append(
                f"finding: {what}: {RESULTS.name} has no ratio to compare {statistics.median(ratios):.2f} with"
            )
        elif min(ratios) > known * CHANGE or max(ratios) < known / CHANGE:
            now = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
            found.append(f"finding: {what}: {now} times the {peer}, {known:.2f} in the table")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--rospy", action="store_true")
    parser.add_argument("--busy", action="store_true")
    parser.add_argument("--again", type=int, metavar="STARTS", default=0)
    given = parser.parse_args()
    if os.getpid() != 1:
        return _contained(sys.argv[1:])
    if given.again:
        return again(given.nodes, given.again, rospy=given.rospy)
    load = os.getloadavg()[0]
    programs = [
        subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(os.cpu_count() or 1) if given.busy
    ]
    runs: list[tuple[Start, Start]] = []
    try:
        for number in range(given.rounds):
            found: dict[str, Start] = {}
            for side in (plain, deployed) if number % 2 else (deployed, plain):
                with side() as (session, masters):
                    found[side.__name__] = start(session, masters, given.nodes, rospy=given.rospy)
            runs.append((found["plain"], found["deployed"]))
    finally:
        for program in programs:
            program.kill()
            program.wait()
    robot = f"{given.nodes} {'rospy' if given.rospy else 'roscpp'} nodes" + (
        ", `--busy`" if given.busy else ""
    )
    _print(runs, f"{robot}, {given.rounds} rounds, load average {load:.1f}")
    ratios = {
        what: [ours.figures[what] / theirs.figures[what] for theirs, ours in runs]
        for what in runs[0][0].figures
    }
    known = table_ratios(RESULTS.read_text(encoding="utf-8"), robot)
    print("\n".join(findings(ratios, known)) if known else f"{RESULTS.name} has no column for this robot")
    return 0


def _contained(arguments: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)  # the appliance's processes run as other users
        inside = subprocess.Popen([*_CONTAINED, *arguments], env=os.environ | {"TMPDIR": folder})
        try:
            return inside.wait()
        finally:
            inside.kill()
            inside.wait()


def _print(runs: list[tuple[Start, Start]], title: str) -> None:
    table = Table("", "rosmaster", "appliance", "ratio (least to greatest)", title=title)
    for what in runs[0][0].figures:
        pairs = [(ours.figures[what], theirs.figures[what]) for theirs, ours in runs]
        ratios = [ours / theirs for ours, theirs in pairs]
        ratio = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        ours, theirs = (statistics.median(side) for side in zip(*pairs, strict=True))
        table.add_row(what, _seconds(theirs), _seconds(ours), ratio)
    Console(width=110).print(table)


def _seconds(value: float) -> str:
    return f"{value * 1000:.1f} ms" if value < 1 else f"{value:.2f} s"


if __name__ == "__main__":
    sys.exit(main())
