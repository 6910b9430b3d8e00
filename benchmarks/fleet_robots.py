"""Simulate appliances for `benchmarks.fleet`, with the real log, signatures and both clients of the collector.

They differ from appliances in two ways: decisions are generated, and a function replaces control's gate.
"""

import logging
import multiprocessing
import os
import random
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess

import structlog
from rosrv_fleet.robots import Robots

from appliance.features.fleet.bundle_link import BundleOffered, BundleStated, RefusedBundle
from appliance.features.fleet.connection import robot_connection
from appliance.features.fleet.process import Poller, PollLoop
from appliance.features.fleet.verified_bundles import VerifiedBundles
from appliance.formats.bundle_api import EVENTS
from fleet.tests.support.bundle_site import GROUP, SITE
from fleet.tests.support.fleet_site import FleetRobot, FleetSite

BAD = "# refused by the gate\n"
"""Simulated appliances refuse a bundle whose policy contains this text."""

_NICENESS = 10  # real robots take no processor time from the collector
_POLL_SECONDS = 300.0
_FORK = multiprocessing.get_context("fork")  # a process gets the site as it is


@dataclass(frozen=True)
class SimulatedLoad:
    """The load of each appliance: it records `records` decisions every `seconds`, and seals them."""

    records: int
    seconds: float
    root: bytes  # the metadata of bundles that robots trust first


def enrol(site: FleetSite, names: Sequence[str]) -> None:
    assert site.data is not None
    robots = Robots(site.data / "robots")
    for name in names:
        folder = site.folder / "robots" / name
        key, certificate = folder / "audit.pub.pem", folder / "tls" / "peer.pem"
        robots.add(name, key.read_bytes(), certificate.read_bytes(), f"{SITE}/{GROUP}")


class SimulatedRobots:
    def __init__(self, site: FleetSite, names: Sequence[str], processes: int, load: SimulatedLoad) -> None:
        self._begin, self._end = _FORK.Event(), _FORK.Event()
        self._results = _FORK.SimpleQueue()
        self._ready = _FORK.Semaphore(0)
        self._processes = [
            _FORK.Process(target=self._run, args=(site, names[start::processes], load), daemon=True)
            for start in range(processes)
        ]

    def start(self) -> None:
        for process in self._processes:
            process.start()
        for _process in self._processes:
            self._ready.acquire()

    def begin(self) -> None:
        self._begin.set()

    def end(self) -> list[float]:
        """Push the rest, and return the seconds from each seal to its receipt."""
        self._end.set()
        lags = [lag for _process in self._processes for lag in self._results.get()]
        for process in self._processes:
            process.join()
        return lags

    def kill(self) -> None:
        for process in self._processes:
            process.kill()
            process.join()

    @property
    def processes(self) -> list[BaseProcess]:
        return list(self._processes)

    def _run(self, site: FleetSite, names: Sequence[str], load: SimulatedLoad) -> None:
        os.nice(_NICENESS)
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
        appliances = [_Appliance(FleetRobot(site, name, enrolled=False, every=10**6), load) for name in names]
        for appliance in appliances:
            appliance.robot.record(load.records)
        self._ready.release()
        self._begin.wait()
        threads = [threading.Thread(target=one.work, args=(self._end.is_set,)) for one in appliances]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self._results.put([lag for one in appliances for lag in one.lags])


class _Appliance:
    def __init__(self, robot: FleetRobot, load: SimulatedLoad) -> None:
        self.robot = robot
        self.lags: list[float] = []
        self._load = load
        self._chance = random.Random(robot.name)
        self._stated = BundleStated()
        self._bundles = self._poll_loop(robot.site, f"https://127.0.0.1:{robot.site.port}")

    def work(self, ended: Callable[[], bool]) -> None:
        self._bundles.start()
        pusher, pause = self.robot.pusher(), threading.Event()
        sealed = time.monotonic()
        due = sealed + self._load.seconds * self._chance.random()
        while not ended():
            wait = pusher.step()
            if wait == 0 or pusher.progress.trouble:
                pause.wait(wait)
                continue
            if sealed:
                self.lags.append(time.monotonic() - sealed)
            sealed = 0.0
            while not ended() and time.monotonic() < due:
                pause.wait(min(1.0, max(0.0, due - time.monotonic())))
            self.robot.record(self._load.records)
            sealed = time.monotonic()
            due += self._load.seconds
        while pusher.progress.sequence < self.robot.sealed():
            pause.wait(pusher.step())
        pusher.close()
        self._bundles.stop(0.0)
        self.robot.close()

    def _poll_loop(self, site: FleetSite, url: str) -> PollLoop:
        tls = self.robot.certificates
        connection, events = (
            robot_connection(url, site.server.ca, tls.certificate, tls.key) for _thread in range(2)
        )
        bundles = VerifiedBundles(
            self.robot.folder / "bundles", self._load.root, connection, site=SITE, group=GROUP,
            robot=self.robot.name,
        )  # fmt: skip
        poller = Poller(bundles, connection, (SITE, GROUP), _POLL_SECONDS, lambda: self._stated, self._judge)
        return PollLoop(poller, events, f"{EVENTS}/{SITE}/{GROUP}")

    def _judge(self, offered: BundleOffered) -> None:
        if BAD in offered.contents.policy:
            refused = RefusedBundle(offered.path, offered.sha256, "policy.ini: refused by the gate")
            self._stated = BundleStated(self._stated.in_force, self._stated.sha256, refused=refused)
        else:
            self._stated = BundleStated(offered.path, offered.sha256)
