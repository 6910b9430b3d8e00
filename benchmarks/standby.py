"""Takeovers by a second appliance, as the robot's nodes see them, and the cost of a registration.

    python -m benchmarks.standby cuts [--cuts 50] [--load 0] [--seed 1] [--monitors FOLDER]
    python -m benchmarks.standby switchovers [--cuts 10] [--load 0] [--monitors FOLDER]
    python -m benchmarks.standby registrations [--rounds 40] [--load 0]

`cuts` cuts the power of the active appliance at a random time. `switchovers` orders the standby to take over. The
table has the longest time without a message, an answer of a service, and an answer of the Master API; 20 ms are
usual. The program fails if a node has ended or an answered change is missing. `registrations` lets one node register
and unregister a topic behind one appliance and behind two, in turns; ratios are of medians. `--load` starts processes
that keep the cores busy.
"""

import argparse
import contextlib
import multiprocessing
import random
import statistics
import tempfile
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.table import Table

from appliance.features.standby import requests as standby_requests
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import MASTER, StandbySite
from tests.support.processes import Process
from tests.support.waiting import NoAnswerError, eventually

_AFTER = 1.0  # seconds of service after the takeover that are also watched
_RATE = 50  # messages a second
_CALLS = 20  # registrations in each turn
_NEVER = threading.Event()
_SECONDS = 60.0  # until a takeover counts as failed


class Successes:
    def __init__(self) -> None:
        self.times = [time.monotonic()]
        self._new = threading.Condition()

    def note(self) -> None:
        with self._new:
            self.times.append(time.monotonic())
            self._new.notify_all()

    def until_after(self, moment: float, seconds: float = _SECONDS) -> float:
        """Return the time of the first success after `moment`, or raise `TimeoutError`."""
        with self._new:
            if not self._new.wait_for(lambda: self.times[-1] > moment, seconds):
                raise TimeoutError(f"nothing worked for {seconds:g} s")
            return next(one for one in self.times if one > moment)

    def longest_pause(self) -> float:
        return max(after - before for before, after in zip(self.times, self.times[1:], strict=False))


class Watch:
    def __init__(self, robot: StandbyRobot) -> None:
        self._robot = robot
        self._ended = threading.Event()
        self.found: dict[str, list[Successes]] = {}
        self.topics: dict[Process, Successes] = {}
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Self:
        robot = self._robot
        robot.registrar.send("time")
        for listener in robot.listeners:
            client = listener.label.partition(" ")[0]
            self.topics[listener] = self._watch(f"topic to {client}", _events(listener, "received"))
        for caller in robot.callers:
            self._watch(f"service from {caller.label.partition(' ')[0]}", _calls(robot, caller))
        self._watch("Master API", _events(robot.registrar, "acknowledged"))
        return self

    def longest_pauses(self) -> dict[str, float]:
        return {name: max(one.longest_pause() for one in these) for name, these in self.found.items()}

    def __exit__(self, *exc: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._robot.registrar.send("rest")

    def _watch(self, name: str, once: Callable[[], None]) -> Successes:
        successes = Successes()
        self.found.setdefault(name, []).append(successes)

        def work() -> None:
            while not self._ended.is_set():
                once()
                successes.note()

        thread = threading.Thread(target=work)
        self._threads.append(thread)
        thread.start()
        return successes


def _events(process: Process, event: str) -> Callable[[], None]:
    mark = [process.mark()]

    def once() -> None:
        process.wait_for(event=event, since=mark[0], timeout=_SECONDS)
        mark[0] = process.mark()

    return once


def _calls(robot: StandbyRobot, caller: Process) -> Callable[[], None]:
    def once() -> None:
        robot.call(caller)
        _NEVER.wait(1 / _RATE)

    return once


@contextlib.contextmanager
def busy(number: int) -> Iterator[None]:
    burning = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(number)]
    for one in burning:
        one.start()
    try:
        yield
    finally:
        for one in burning:
            one.kill()


def _burn() -> None:
    while True:
        pass


def takeovers(number: int, load: int, seed: int, monitors: Path | None, *, planned: bool) -> None:
    chance, pauses = random.Random(seed), dict[str, list[float]]()
    options = () if monitors is None else ("--monitors", str(monitors), "--enable", "all")
    with (
        tempfile.TemporaryDirectory() as home,
        Lab("rosrv-bench") as lab,
        StandbySite(lab, Path(home), options=options) as site,
    ):
        site.start_witness()
        site.start("a")
        site.until_active("a")
        site.start("b")
        site.until_both_in_sync()
        with StandbyRobot(site, rate=_RATE) as robot, busy(load):
            for turn in range(number):
                _NEVER.wait(chance.uniform(0, 1))
                found = one_takeover(site, robot, planned=planned)
                for name, pause in found.items():
                    pauses.setdefault(name, []).append(pause)
                print(turn + 1, {name: round(pause, 2) for name, pause in found.items()}, flush=True)
            robot.lost_nothing()
    print_pauses(pauses, f"{number} takeovers, load {load}")


def print_pauses(pauses: dict[str, list[float]], title: str) -> None:
    table = Table("seconds without", "least", "median", "most", title=title)
    pauses["any of them"] = [max(turn) for turn in zip(*pauses.values(), strict=True)]
    for name, times in pauses.items():
        table.add_row(name, *(f"{one:.2f}" for one in (min(times), statistics.median(times), max(times))))
    Console().print(table)


def one_takeover(site: StandbySite, robot: StandbyRobot, *, planned: bool) -> dict[str, float]:
    """Return the longest pause of each measured service, once both appliances are in sync again."""
    active, passive = site.pair()
    with Watch(robot) as watch:
        if planned:
            # The answer may be lost: its appliance is the standby then.
            with contextlib.suppress(NoAnswerError):
                site.appliances[active].ask(standby_requests.StandbyPromote())
        else:
            site.cut(active)
        site.until_taken_over(passive)
        taken = time.monotonic()
        for successes in (one for these in watch.found.values() for one in these):
            successes.until_after(taken + _AFTER)
    if not planned:
        site.restore(active)
    site.until_both_in_sync()
    eventually(lambda: site.pids(active, "control"), site.story)
    return watch.longest_pauses()


def registrations(rounds: int, load: int) -> None:
    times: dict[str, list[float]] = {"one": [], "two": []}
    with contextlib.ExitStack() as stack:
        turns = {kind: stack.enter_context(_behind(pair=kind == "two")) for kind in times}
        stack.enter_context(busy(load))
        for turn in range(rounds + 1):
            for kind, take_turn in turns.items():
                found = take_turn()
                times[kind] += found if turn else []  # the first turn opens connections
    table = Table(
        "appliances", "median", "90 %", "ratio", title=f"milliseconds of a registration, load {load}"
    )
    single = statistics.median(times["one"])
    for kind, found in times.items():
        middle = statistics.median(found)
        late = statistics.quantiles(found, n=10)[8]
        table.add_row(kind, f"{1e3 * middle:.2f}", f"{1e3 * late:.2f}", f"{middle / single:.2f}")
    Console().print(table)


@contextlib.contextmanager
def _behind(*, pair: bool) -> Iterator[Callable[[], list[float]]]:
    lab = Lab(f"rosrv-bench-{'pair' if pair else 'single'}")
    with tempfile.TemporaryDirectory() as home, lab:
        if not pair:
            robot = lab.host("robot", "10.79.0.10/24")
            with Appliance(lab.host("a", "10.79.0.2/24")) as one:
                yield lambda: robot.run(lambda: _registered(one.master_uri))
        else:
            with StandbySite(lab, Path(home)) as site:
                site.start_witness()
                site.start("a")
                site.until_active("a")
                site.start("b")
                site.until_both_in_sync()
                yield lambda: site.robot.run(lambda: _registered(MASTER))


def _registered(master: str) -> list[float]:
    times = []
    with xmlrpc.client.ServerProxy(master) as proxy:
        proxy.getPid("/bench")
        for number in range(_CALLS):
            method = proxy.unregisterPublisher if number % 2 else proxy.registerPublisher
            kind = () if number % 2 else ("std_msgs/String",)
            began = time.monotonic()
            answer = method("/bench", "/bench/topic", *kind, "http://10.79.0.10:9/")
            times.append(time.monotonic() - began)
            if not isinstance(answer, list) or answer[0] != 1:
                raise RuntimeError(f"a registration failed: {answer!r}")
    return times


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("what", choices=("cuts", "switchovers", "registrations"))
    arguments.add_argument("--cuts", type=int, default=50, help="takeovers")
    arguments.add_argument("--rounds", type=int, default=40, help="turns of each kind, with 20 calls each")
    arguments.add_argument("--load", type=int, default=0, help="processes that compute")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--monitors", type=Path, help="folder of specifications, all enabled")
    given = arguments.parse_args()
    if given.what == "registrations":
        registrations(given.rounds, given.load)
    else:
        takeovers(given.cuts, given.load, given.seed, given.monitors, planned=given.what == "switchovers")


if __name__ == "__main__":
    main()
