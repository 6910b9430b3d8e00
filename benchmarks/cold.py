"""The cost of a message as users pay it: `python -m benchmarks.cold [--busy] [--ordinary]` (under two minutes).

The relay of `rosrv up`, without a monitor and with one (two fields read, one written, one FSM step), takes turns with
a direct connection, `copying_relay.c` with epoll, and five lines of Python. Cells are medians of the rounds; in
parentheses are the median, the least and the greatest ratio to the C relay in the same round. *paced100* and
*paced1000* are messages a second, with real-time priority for the load if permitted; *window* keeps 64 messages on
their way. `--busy` adds programs that use half of each core and walk through their memory. The processor time is that
of the process in the middle. Needs g++, rosmaster and chrt.

A robot's nodes have no real-time priority: with `--ordinary`, the load has none, so the relay's priority shows. A
second C relay has the same priority, to tell its effect from that of the relay's code. The last lines are the rows of
the table in `benchmarks/RESULTS.md`. `--findings` prints each median delay whose ratio to the C relay is beyond the
table's by more than 20 % in every round, as `make nightly` does.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from appliance.supervisor.roles import ROLES
from benchmarks.launch import LONE, findings, table_ratios
from benchmarks.monitors import CopyingRelay, MinimalRelay, specification
from benchmarks.relay_throughput import HERE, TYPE, Direct, LoadApi, Result, System, run
from tests.support.appliance import Appliance
from tests.support.relay_driver import call

POLICY = """
[Nodes]
/load          = 127.0.0.1
/load_listener = 127.0.0.1
[Publishers]
/load = 127.0.0.1
[Subscribers]
/load = 127.0.0.1
[Commands]
default = 127.0.0.1
"""
BASE = "C with epoll"
NICENESS = next(role.nice for role in ROLES if role.name == "relay")
SECONDS = {"paced": 2.0, "window": 0.4}
SIZES = {"paced": (200,), "window": (200, 4096, 65536, 1048576, 4194304)}
MODES = ("paced100", "paced1000", "window")
REALTIME = ("chrt", "--fifo", "10")
OTHER_PROGRAM = """
import threading, time
memory, part, at, pause = bytearray(8 << 20), 1 << 16, 0, threading.Event()
while True:
    began, used = time.monotonic(), time.thread_time()
    while time.thread_time() - used < 0.0025:
        memory.count(1, at, at + part)
        at = (at + part) % len(memory)
    pause.wait(max(0, began + 0.005 - time.monotonic()))
"""


class FavouredRelay(CopyingRelay):
    """The C relay with the niceness of the appliance's relay, alone in its session like that one."""

    def __init__(self) -> None:
        super().__init__(epoll=True)
        self.name = f"{BASE}, niceness {NICENESS}"

    def target(self, publisher: int) -> tuple[int, str]:
        answer = super().target(publisher)
        assert self.pid is not None
        os.setpriority(os.PRIO_PROCESS, self.pid, NICENESS)
        autogroup = Path(f"/proc/{self.pid}/autogroup")
        if autogroup.exists():  # as `privileges.add_niceness` does
            autogroup.write_text(str(NICENESS), encoding="ascii")
        return answer


class DeployedRelay:
    """The relay of a running appliance. The load's nodes register again for each run."""

    def __init__(self, name: str, *specifications: str) -> None:
        self.name = name
        monitors = {str(number): text for number, text in enumerate(specifications)}
        self._appliance = Appliance(policy=POLICY, monitors=monitors, options=("--api", "127.0.0.1:0"))
        definition = self._appliance.directory / "monitors" / "msg" / f"{TYPE}.msg"
        definition.parent.mkdir(parents=True)
        definition.write_text((HERE / "nodes" / "msg" / f"{TYPE}.msg").read_text())
        self._api = LoadApi()
        self.pid: int | None = None
        try:
            self._appliance.start()
            [self.pid] = self._appliance.pids("relay")
        except BaseException:
            self.close()
            raise

    def target(self, publisher: int) -> tuple[int, str]:
        self._call("unregisterSubscriber", "/load_listener", "/load", self._api.uri)
        self._call("unregisterPublisher", "/load", "/load", self._api.uri)
        self._api.publisher = publisher
        self._call("registerPublisher", "/load", "/load", TYPE, self._api.uri)
        [node] = self._call("registerSubscriber", "/load_listener", "/load", TYPE, self._api.uri)
        _code, _text, (_protocol, _host, port) = call(
            node, "requestTopic", "/load_listener", "/load", [["TCPROS"]]
        )
        return port, "/load"

    def close(self) -> None:
        self._appliance.close()
        self._api.close()

    def _call(self, method: str, *arguments: str) -> Any:
        code, text, value = call(self._appliance.master_uri, method, *arguments)
        if code != 1:
            raise SystemExit(f"{method} of the appliance: {text}\n{self._appliance.story()}")
        return value


SYSTEMS: tuple[Callable[[], System], ...] = (
    Direct,
    lambda: CopyingRelay(epoll=True),
    FavouredRelay,
    lambda: MinimalRelay("five lines of Python", sys.executable, str(HERE / "nodes" / "copying_relay.py")),
    lambda: DeployedRelay("deployed, no monitor"),
    lambda: DeployedRelay("deployed, one monitor", specification("load", "/load")),
)


@contextmanager
def other_programs(number: int) -> Iterator[None]:
    programs = [
        subprocess.Popen([sys.executable, "-c", OTHER_PROGRAM], start_new_session=True) for _ in range(number)
    ]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def realtime() -> tuple[str, ...]:
    permitted = subprocess.run([*REALTIME, "true"], check=False, stderr=subprocess.DEVNULL).returncode == 0
    return REALTIME if permitted else ()


def cell(runs: list[Result], base: list[Result], value: Callable[[Result], float]) -> str:
    middle = statistics.median(map(value, runs))
    if not middle:
        return "-"
    ratios = [value(one) / value(other) for one, other in zip(runs, base, strict=True)]
    digits = 2 if middle < 10 else 0
    return f"{middle:,.{digits}f} ({statistics.median(ratios):.2f}, {min(ratios):.2f}-{max(ratios):.2f})"


def show(mode: str, size: int, results: dict[str, list[Result]]) -> None:
    columns: dict[str, Callable[[Result], float]] = {"processor µs": lambda one: one.cpu}
    if mode == "window":
        title, columns = "64 messages on their way", {"messages/s": lambda one: one.rate} | columns
    else:
        title = f"{int(mode.removeprefix('paced')):,} messages a second"
        columns = {"p50 µs": lambda one: one.p50, "p99 µs": lambda one: one.p99} | columns
    table = Table("in the middle", *columns, "lost", title=f"{title}, {size:,} bytes")
    for name, runs in results.items():
        cells = [cell(runs, results[BASE], value) for value in columns.values()]
        table.add_row(name, *cells, f"{sum(one.lost for one in runs):,}")
    Console(width=130).print(table)


def modes(text: str) -> list[str]:
    found = text.split(",")
    wrong = [one for one in found if not re.fullmatch(r"window|paced[1-9]\d*", one)]
    if wrong:
        raise argparse.ArgumentTypeError(
            f"no mode {wrong[0]!r}: give window, paced100, paced1000 or the like"
        )
    return found


def delays(results: Mapping[tuple[str, int], Mapping[str, Sequence[Result]]]) -> dict[str, list[float]]:
    """Return the ratios of the median delay to the C relay's, by the names of rows in the table."""
    return {
        f"{mode.removeprefix('paced')} messages a second: {name}": [
            run.p50 / base.p50 for run, base in zip(runs, found[BASE], strict=True)
        ]
        for (mode, _size), found in results.items()
        if mode != "window"
        for name, runs in found.items()
        if name.startswith(("deployed", f"{BASE},"))
    }


def rows(results: Mapping[tuple[str, int], Mapping[str, Sequence[Result]]]) -> Iterator[str]:
    """Yield the rows of the table of lone messages in RESULTS.md: the C relay's median delay, ours, and the ratio."""
    for (mode, _size), found in results.items():
        base = statistics.median(run.p50 for run in found[BASE])
        for what, ratios in delays({(mode, 0): found}).items():
            ours = statistics.median(run.p50 for run in found[what.partition(": ")[2]])
            yield f"| {what} | {base:.0f} / {ours:.0f} µs, {statistics.median(ratios):.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, help="of each run (2; window: 0.4)")
    parser.add_argument("--sizes", type=lambda text: tuple(int(one) for one in text.split(",")))
    parser.add_argument(
        "--modes", type=modes, default=list(MODES), help=f"{','.join(MODES)}, or another pace"
    )
    parser.add_argument("--busy", action="store_true", help="with other programs on half of each core")
    parser.add_argument("--ordinary", action="store_true", help="the load has no real-time priority")
    parser.add_argument("--findings", action="store_true", help="compare with the table in RESULTS.md")
    options = parser.parse_args()
    prefix, cores = () if options.ordinary else realtime(), len(os.sched_getaffinity(0))
    print(f"real-time priority of the load, if paced: {'yes' if prefix else 'no'}")
    print(f"other programs: {f'one on each of {cores} cores, half of the time' if options.busy else 'none'}")
    results: dict[tuple[str, int], dict[str, list[Result]]] = {}
    with ExitStack() as running:
        systems: list[System] = []
        for start in SYSTEMS:
            systems.append(start())
            running.callback(systems[-1].close)
        running.enter_context(other_programs(cores if options.busy else 0))
        for _round in range(options.rounds):
            for mode in options.modes:
                kind = mode.rstrip("0123456789")
                for size in options.sizes or SIZES[kind]:
                    for system in systems:
                        given = options.seconds or SECONDS[kind]
                        result = run(mode, size, given, system, prefix=prefix if kind == "paced" else ())
                        results.setdefault((mode, size), {}).setdefault(system.name, []).append(result)
    for (mode, size), found in results.items():
        show(mode, size, found)
    if options.ordinary:
        print("\n".join(rows(results)))
    if options.findings:
        column = f"{LONE}, `--busy`" if options.busy else LONE
        known = table_ratios((HERE / "RESULTS.md").read_text(encoding="utf-8"), column)
        print("\n".join(findings(delays(results), known, "C relay's")))


if __name__ == "__main__":
    main()
