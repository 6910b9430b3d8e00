"""Short faults of a pair of appliances, as the robot's nodes see them.

    python -m benchmarks.standby_faults interruptions|follower|stalls|link|robot [--number 20] [--load 0] [--seed 1]

| fault | effect |
|---|---|
| `interruptions` | no packet passes between the robot's computers and both appliances, for 2 to 8 s |
| `follower` | the cable of the robot's second computer, a follower, is unplugged for 2 to 8 s |
| `stalls` | the process `lease` of the active appliance is paused for 0.7 to 1 s |
| `alone` | the same, while the standby is off |
| `link` | no packet passes between the two appliances, for 2 to 8 s |
| `standby` | no packet passes between the standby and the robot, for 2 to 8 s |
| `robot` | the witness ends, and its boot rules shut out both appliances, for 0.5 to 4 s |

The table shows the longest time without a message, an answer of a service, and an answer of the Master API, or for
`interruptions`, `follower` and `robot` the time from the end of the fault. A subscription that gets no message for 20
s after the fault is lost: the program counts it, and starts its node again.
"""

import argparse
import contextlib
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.standby import Successes, Watch, busy, print_pauses
from examples.landshark.lab import Host, Lab
from tests.support.features.standby.standby_robot import CLIENTS, StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, ARM, ROBOT, StandbySite
from tests.support.processes import Process
from tests.support.waiting import eventually

_RATE = 20  # messages a second
_WATCHED_SECONDS = 3.0  # after everything works, for what ends only then
_SLOW_SECONDS = 5.0
_BACK_SECONDS = 20.0  # until a subscription counts as lost
_NEVER = threading.Event()
Fault = Callable[[StandbySite], contextlib.AbstractContextManager[object]]


def _interrupted(site: StandbySite) -> contextlib.AbstractContextManager[object]:
    return site.without_link(*((ADDRESSES[one], there) for one in ADDRESSES for there in (ROBOT, ARM)))


@contextlib.contextmanager
def _unplugged(site: StandbySite) -> Iterator[None]:
    site.lab.unplug(site.lab.hosts["arm"])
    try:
        yield
    finally:
        site.lab.plug(site.lab.hosts["arm"])


@contextlib.contextmanager
def _stalled(site: StandbySite) -> Iterator[None]:
    (lease,) = site.pids(site.holder(), "lease")
    os.kill(lease, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(lease, signal.SIGCONT)


def _without_standby(site: StandbySite) -> contextlib.AbstractContextManager[object]:
    passive = site.pair()[1]
    if site.in_sync() != {site.holder()}:
        site.cut(passive)
        eventually(lambda: site.in_sync() == {site.holder()}, site.story)
        _NEVER.wait(2)
    return _stalled(site)


def _link(site: StandbySite) -> contextlib.AbstractContextManager[object]:
    return site.without_link((ADDRESSES["a"], ADDRESSES["b"]))


def _blind_standby(site: StandbySite) -> contextlib.AbstractContextManager[object]:
    return site.without_link((ADDRESSES[site.pair()[1]], ROBOT))


@contextlib.contextmanager
def _shut(site: StandbySite) -> Iterator[None]:
    site.stop_witness()
    with Process(site.robot, site.command("shut"), env=dict(os.environ), label="shut") as shut:
        shut.wait()
    try:
        yield
    finally:
        site.start_witness()


FAULTS: dict[str, tuple[Fault, float, float, bool]] = {
    "interruptions": (_interrupted, 2, 8, True),
    "follower": (_unplugged, 2, 8, True),
    "stalls": (_stalled, 0.7, 1, False),
    "alone": (_without_standby, 0.7, 1, False),
    "link": (_link, 2, 8, False),
    "standby": (_blind_standby, 2, 8, False),
    "robot": (_shut, 0.5, 4, True),
}


def faults(kind: str, number: int, load: int = 0, seed: int = 1) -> int:
    make, least, most, after = FAULTS[kind]
    chance, pauses, lost = random.Random(seed), dict[str, list[float]](), 0
    with (
        tempfile.TemporaryDirectory() as home,
        Lab("rosrv-faults") as lab,
        StandbySite(lab, Path(home)) as site,
    ):
        site.start_witness()
        arm = site.start_follower()
        site.start("a")
        site.until_active("a")
        site.start("b")
        site.until_both_in_sync()
        with StandbyRobot(site, rate=_RATE) as robot, busy(load):
            _put_nodes_on(robot, arm)
            robot.works()
            for turn in range(number):
                _NEVER.wait(chance.uniform(1, 2))
                seconds = chance.uniform(least, most)
                in_sync = 1 if kind == "alone" else 2
                found, gone = _one(site, robot, make(site), seconds, after=after, in_sync=in_sync)
                lost += gone
                for name, pause in found.items():
                    pauses.setdefault(name, []).append(pause)
                rounded = {name: round(pause, 2) for name, pause in found.items()}
                print(turn + 1, f"{seconds:.2f} s", rounded, f"lost {gone}", flush=True)
            robot.lost_nothing()
    print_pauses(pauses, f"{number} times: {kind}, load {load}")
    print(f"subscriptions lost: {lost}")
    return lost


def _put_nodes_on(robot: StandbyRobot, arm: Host) -> None:
    there = robot.ros.on(arm)
    for talker in CLIENTS:
        there.talker(talker, f"/arm_{talker}", "--rate", str(_RATE), name=f"arm_talker_{talker}")
    for client in CLIENTS:
        for talker in CLIENTS:
            name = f"{client}_hears_{talker}"
            robot.listeners.append(there.listener(client, f"/from_{talker}", name=f"arm_{name}"))
            robot.listeners.append(robot.ros.listener(client, f"/arm_{talker}", name=f"robot_{name}"))


def _one(
    site: StandbySite,
    robot: StandbyRobot,
    fault: contextlib.AbstractContextManager[object],
    seconds: float,
    *,
    after: bool,
    in_sync: int,
) -> tuple[dict[str, float], int]:
    """Return the times without service, and the number of lost subscriptions.

    `in_sync` is the number of appliances that are in sync some time after the fault.
    """
    lost: list[Process] = []
    with Watch(robot) as watch:
        with fault:
            _NEVER.wait(seconds)
        ended = time.monotonic()
        back = {
            name: max(_seconds_until_back(one, ended) for one in these) for name, these in watch.found.items()
        }
        for listener, successes in watch.topics.items():
            took = _seconds_until_back(successes, ended)
            if took > _SLOW_SECONDS:
                print(f"{took:.1f} s: {listener.command[-1]}", flush=True)
        _NEVER.wait(_WATCHED_SECONDS)
        again = time.monotonic()
        for listener, successes in watch.topics.items():
            if _seconds_until_back(successes, again) >= _BACK_SECONDS:
                lost.append(listener)
    for listener in lost:
        print("lost:", listener.command)
        robot.listeners.remove(listener)
        listener.stop()
        robot.ros.processes.remove(listener)
        host = site.lab.hosts["arm" if "__name:=arm_" in listener.command[-1] else "robot"]
        robot.listeners.append(robot.ros.on(host).start(listener.command, label=listener.label))
    eventually(lambda: len(site.in_sync()) == in_sync, site.story)
    robot.works()
    return back if after else watch.longest_pauses(), len(lost)


def _seconds_until_back(successes: Successes, moment: float) -> float:
    try:
        return successes.until_after(moment, _BACK_SECONDS) - moment
    except TimeoutError:
        return _BACK_SECONDS


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("kind", choices=FAULTS)
    arguments.add_argument("--number", type=int, default=20)
    arguments.add_argument("--load", type=int, default=0, help="processes that compute")
    arguments.add_argument("--seed", type=int, default=1)
    given = arguments.parse_args()
    faults(given.kind, given.number, given.load, given.seed)


if __name__ == "__main__":
    main()
