"""The time until a bundle is in force everywhere: `python -m benchmarks.fleet_bundles [--robots 1000] [--processes 4]`.

Each robot is the real client of the appliance: both threads, its own certificate, TLS connections and trusted metadata
on the disk. They differ from a robot in one thing: control's gate is replaced by a function that takes every bundle at
once, because compiling and the trial (`confirm_seconds`) take place on the robots, all at the same time. The collector
is the real one with PostgreSQL, on the same machine. All robots are in one ring, so the collector wakes all of them at
once. The time runs from the operator's order until the collector knows that every robot has the bundle in force.
"""

import argparse
import logging
import multiprocessing
import os
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event
from pathlib import Path

import httpx
import structlog
from rosrv_fleet.rollouts.store import Group

from appliance.bundles.collector_connection import CollectorConnection, robot_context
from appliance.bundles.poller import Poller
from appliance.bundles.process import EVENTS, PollLoop
from appliance.bundles.terms import Ring
from appliance.bundles.verified_bundles import VerifiedBundles
from appliance.channel.messages import BundleOffered, BundleStated
from tests.support.bundle_site import GROUP, SITE, BundleSite, bundle_files, everywhere
from tests.support.rollout_collector import RolloutCollector, collector
from tests.system.fleet.postgres import postgres

_INTERVAL = 300.0
_PAUSE = threading.Event()  # never set


class _Robot:
    """A robot that takes every bundle that TUF has verified."""

    def __init__(  # noqa: PLR0917  the facts of one robot
        self, url: str, folder: Path, root: bytes, ca: Path, certificate: tuple[Path, Path], name: str
    ) -> None:
        context = robot_context(ca, *certificate)
        connection = CollectorConnection(url, context, None)
        bundles = VerifiedBundles(folder, root, connection, site=SITE, group=GROUP, robot=name)
        self.stated = BundleStated()
        poller = Poller(bundles, connection, (SITE, GROUP), _INTERVAL, lambda: self.stated, self._take)
        self.loop = PollLoop(poller, CollectorConnection(url, context, None), f"{EVENTS}/{SITE}/{GROUP}")

    def _take(self, offered: BundleOffered) -> None:
        self.stated = BundleStated(offered.path, offered.sha256)


def _robots(  # noqa: PLR0917  the facts of a process
    url: str, folder: Path, root: bytes, ca: Path, certificates: list[tuple[str, Path, Path]], end: Event
) -> None:
    """Run robots in this process until the end."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    robots = []
    for name, certificate, key in certificates:
        robot = _Robot(url, folder / name, root, ca, (certificate, key), name)
        robot.loop.start()
        robots.append(robot)
    end.wait()


def _until(running: RolloutCollector, wanted: str, count: int, seconds: float) -> float:
    """Wait until this many robots have reported a bundle in force (empty: reported at all); return the time."""
    began = time.monotonic()

    def there() -> int:
        robots = running.service.robots.get(Group(SITE, GROUP), {})
        return sum(robot.in_force == wanted for robot in list(robots.values()))

    while time.monotonic() - began < seconds:
        if there() >= count:
            return time.monotonic() - began
        _PAUSE.wait(0.2)
    raise SystemExit(f"{there()} of {count} robots after {seconds:g} s")


def _processor_seconds(workers: Sequence[BaseProcess]) -> float:
    """Return the processor time of the collector and the robots: on a busy machine it says more than the time."""
    ticks = 0
    for pid in (os.getpid(), *(worker.pid for worker in workers)):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--bundles", type=int, default=3)
    wanted = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rosrv-fleet-"))
    site = BundleSite(folder / "site")
    names = [f"robot-{number}" for number in range(wanted.robots)]
    certificates = [(name, *site.authority.issue(name)) for name in names]
    end = multiprocessing.get_context("spawn").Event()
    with (
        postgres() as cluster,
        collector(site.repository.folder, site.authority, cluster.create("bundles")) as running,
    ):
        operator = httpx.Client(
            base_url=running.url,
            verify=robot_context(site.authority.ca, *site.authority.issue("operator")),
            timeout=60,
            trust_env=False,
        )
        parts = [certificates[start :: wanted.processes] for start in range(wanted.processes)]
        site.repository.add(SITE, GROUP, bundle_files(), everywhere(None, Ring("all", [], 100)))
        workers = [
            multiprocessing.get_context("spawn").Process(
                target=_robots,
                args=(running.url, folder / "robots", site.first_root, site.authority.ca, part, end),
                daemon=True,
            )
            for part in parts
        ]
        for worker in workers:
            worker.start()
        print(f"{wanted.robots} robots are connected after {_until(running, '', wanted.robots, 600):.1f} s")
        times = []
        for number in range(1, wanted.bundles + 1):
            name = f"{SITE}/{GROUP}/{number}.tar"
            if number > 1:
                site.repository.add(
                    SITE, GROUP, bundle_files(policy_dot_ini=f"[Nodes]\n# {number}\n"),
                    everywhere(None, Ring("all", [], 100)),
                )  # fmt: skip
            _PAUSE.wait(5)
            began, before = time.monotonic(), _processor_seconds(workers)
            order = {"bundle": name, "gates": {"healthy_seconds": 0, "share": 1, "silent_seconds": 600}}
            answer = operator.post("/v1/rollouts", json=order)
            answer.raise_for_status()
            _until(running, name, wanted.robots, 300)
            times.append(time.monotonic() - began)
            used = _processor_seconds(workers) - before
            print(
                f"bundle {number} is in force on {wanted.robots} robots after {times[-1]:.1f} s,"
                f" with {used:.1f} s of processor time, without PostgreSQL's"
            )
        print(f"median {statistics.median(times):.1f} s of {len(times)}")
        end.set()
        for worker in workers:
            worker.terminate()
            worker.join()
        operator.close()
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
