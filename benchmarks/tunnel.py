"""A tunnel beside the clear path, in one run: `python -m benchmarks.tunnel [--seconds 5] [--rounds 3] [--machine]`.

The same host publishes to the robot (rospy at both ends, through the relay) and calls RVMaster, in turns through its
tunnel and in clear text from its own address. Cells are medians of the rounds, ratios medians of the rounds' ratios.
Then the time from `host add` to the first message through the tunnel is measured.

ESP runs where this machine supports it. `--machine` runs everything in the tests' virtual machine, whose kernel has
ESP; without KVM, all figures there are about ten times slower. Needs root.
"""

import argparse
import contextlib
import http.client
import itertools
import statistics
import tempfile
import time
import xmlrpc.client
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.relay_throughput import HERE
from examples.landshark.lab import Lab
from tests.support.machine import Machine
from tests.support.machine_disk import ROOT
from tests.support.nodes import PYTHON, RosSession
from tests.support.processes import LIMIT
from tests.support.processes import Host as AnyHost
from tests.support.tunnel_site import MASTER, MIDDLE, OCU, OWN, POLICY, TunnelSite
from tests.support.tunnels import JoinedHost

NODE = HERE / "nodes" / "stamping_node.py"
SIZES = (200, 65536)
PACED = 200.0  # messages a second


@dataclass(frozen=True)
class Way:
    name: str
    master: str
    host: AnyHost
    target: str
    source: str


@dataclass(frozen=True)
class Measure:
    name: str
    unit: str
    run: Callable[[Way], float]


class Bench:
    """The trusted host, both behind its tunnel and at its own address in clear text."""

    def __init__(self, site: TunnelSite, joined: JoinedHost, seconds: float) -> None:
        self.site, self.joined, self.seconds = site, joined, seconds
        self.paths = (
            Way("clear", MASTER, site.ocu, MIDDLE, OCU),
            Way("tunnel", joined.master, joined, OWN, joined.address),
        )

    def measures(self) -> list[Measure]:
        rows = [Measure(f"{size:,} bytes, flat out", "messages/s", self._flat(size)) for size in SIZES]
        rows.append(Measure(f"200 bytes, {PACED:.0f}/s: delay", "µs (median)", self._paced))
        rows.append(Measure("getSystemState, one caller", "calls/s", self._calls))
        return rows

    def _flat(self, size: int) -> Callable[[Way], float]:
        return lambda path: self._messages(path, size, 0)[0]

    def _paced(self, path: Way) -> float:
        return self._messages(path, 200, PACED)[1]

    def _messages(self, path: Way, size: int, hertz: float) -> tuple[float, float]:
        home = self.site.home
        with (
            RosSession(MASTER, home, self.site.robot) as here,
            RosSession(path.master, home, path.host) as there,
        ):
            counter = here.start([PYTHON, str(NODE), "subscribe", "/load"])
            counter.wait_for(event="ready")
            words = [str(size), str(hertz), str(self.seconds)]
            publisher = there.start([PYTHON, str(NODE), "publish", "/load", *words])
            publisher.wait(timeout=self.seconds + LIMIT)
            counter.send("")
            counted = counter.wait_for(event="counted")
        return counted["received"] / counted["seconds"], statistics.median(counted["delays"])

    def _calls(self, path: Way) -> float:
        body = xmlrpc.client.dumps(("/bench",), "getSystemState").encode()

        def work() -> float:
            line = http.client.HTTPConnection(path.target, 11311, LIMIT, source_address=(path.source, 0))
            count, began = 0, time.monotonic()
            while time.monotonic() - began < self.seconds:
                line.request("POST", "/", body, {"Content-Type": "text/xml"})
                answer = line.getresponse()
                assert answer.status == 200
                answer.read()
                count += 1
            return count / (time.monotonic() - began)

        return self.site.ocu.run(work)


def first_message(site: TunnelSite) -> tuple[JoinedHost, list[tuple[str, float]]]:
    moments = [("", time.monotonic())]
    kit = site.kit()
    moments.append(("`host add`: the kit is there", time.monotonic()))
    joined = site.join(kit).start()
    joined.wait_until_up()
    moments.append(("the host's charon starts, the tunnel is up", time.monotonic()))
    with site.talking(joined):
        moments.append(("two rospy nodes start, the first message is heard", time.monotonic()))
    return joined, [(name, moment - before) for (_, before), (name, moment) in itertools.pairwise(moments)]


def measure(bench: Bench, rounds: int) -> Table:
    where = bench.site.appliance.status()["ipsec"]["esp"]
    table = Table("", "", *(path.name for path in bench.paths), "tunnel / clear", title=f"ESP in: {where}")
    for one in bench.measures():
        results = [[one.run(path) for path in bench.paths] for _ in range(rounds)]
        cells = [f"{statistics.median(column):,.0f}" for column in zip(*results, strict=True)]
        ratio = statistics.median(tunnel / clear for clear, tunnel in results)
        table.add_row(one.name, one.unit, *cells, f"{ratio:.2f}")
    return table


def here(seconds: float, rounds: int) -> None:
    console = Console(width=110)
    # For this comparison, the host in clear text is trusted by its address.
    policy = POLICY.replace("trusted = host:ocu-1,", f"trusted = host:ocu-1, {OCU},")
    with (
        tempfile.TemporaryDirectory(prefix="rosrv-bench-") as folder,
        Lab("rosrv-benchtun") as lab,
        TunnelSite(lab, Path(folder), policy=policy) as site,
        contextlib.ExitStack() as joined_hosts,
    ):
        joined, steps = first_message(site)
        joined_hosts.callback(joined.stop)
        console.print(measure(Bench(site, joined, seconds), rounds))
    table = Table("from `host add` to the first message through the tunnel", "s")
    for name, spent in [*steps, ("together", sum(spent for _, spent in steps))]:
        table.add_row(name, f"{spent:.1f}")
    console.print(table)


def in_the_machine(seconds: float, rounds: int) -> None:
    with tempfile.TemporaryDirectory(prefix="rosrv-bench-") as folder, Machine(Path(folder)) as machine:
        words = ["--seconds", str(seconds), "--rounds", str(rounds)]
        print(f"virtual machine: {machine.accelerator}, {machine.processors} processors")
        print(machine.run(f"{ROOT}/.venv/bin/python", "-m", "benchmarks.tunnel", *words, seconds=3600).output)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--machine", action="store_true", help="in the tests' virtual machine")
    given = parser.parse_args()
    (in_the_machine if given.machine else here)(given.seconds, given.rounds)


if __name__ == "__main__":
    main()
