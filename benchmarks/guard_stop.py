"""Time until the guard `deadman` stops a base whose operator falls silent: python -m benchmarks.guard_stop [--busy]

A rospy node commands full speed 50 times a second, and falls silent. The time is from its last call of `publish`
until the base's callback for the stop, minus the guard's `silent`. With `--busy`, another program keeps a core busy.

With `--drive MINUTES`, a base drives under five guards beside two busy loops, with a scanner of 1,080 rays, while
guards are loaded and set, nodes fall silent and the appliance restarts. A line says when it moved again after each act,
and how many scans others lost.
"""

import argparse
import math
import os
import statistics
import sys
import tempfile
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from appliance.features.guards.presets import PRESETS, Guard, text_of
from benchmarks.cold import realtime
from benchmarks.published_stop import busy_programs
from benchmarks.relay_throughput import HERE
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import (
    ACTS,
    VELOCITY,
    Act,
    GuardedRobot,
    Passage,
    rows,
    scans,
)
from tests.support.nodes import PYTHON, RosSession

ALLOWED = 20.0
"""The milliseconds by which a stop may be late."""


def lateness(trials: int, silent: float) -> list[float | None]:
    """Return the milliseconds by which each stop was late, or None without a stop."""
    text = text_of(Guard("deadman", PRESETS["deadman"], values={"silent": f"{silent:g}"}))
    with (
        Appliance(monitors={"deadman": text}) as appliance,
        tempfile.TemporaryDirectory() as home,
        RosSession(appliance.master_uri, Path(home)) as session,
    ):
        command = [*realtime(), PYTHON, str(HERE / "nodes" / "cut_node.py"), str(trials), str(silent)]
        measured = session.start(command).wait_for(event="measured", timeout=60 + 5 * trials)
    found: list[float | None] = measured["late"]
    return found


def drives(robot: GuardedRobot) -> None:
    """Let the base drive; the seconds are the longest without a motion."""


def drive(minutes: float) -> int:
    """Drive a base under five guards with an act now and then; return the number of times that something was lost."""
    presets = ("separation", "zone", "fence", "speed", "deadman")
    commands = replace(VELOCITY, hertz=10, frames=VELOCITY.frames[1:4])
    streams = {VELOCITY.kind: commands, "sensor_msgs/LaserScan": replace(scans(1080), hertz=15)}
    guards = [
        (
            replace(row, streams={name: streams.get(one.kind, one) for name, one in row.streams.items()}),
            row.guard(),
        )
        for row in rows(1080)
        if row.preset in presets
    ]
    broken = 0
    with (
        Lab("rosrv-drive") as lab,
        busy_programs(2),
        Appliance(lab.host("appliance", "10.77.0.2/24"), options=("--api", "off")) as appliance,
        tempfile.TemporaryDirectory() as home,
        GuardedRobot(
            appliance,
            RosSession(appliance.master_uri, Path(home), lab.host("robot", "10.77.0.10/24")),
            guards,
        ) as robot,
    ):
        print(f"first motion: {robot.moves(0) < math.inf}")
        robot.lost()  # before the nodes were connected
        for act in ACTS:
            began = time.monotonic()
            threading.Event().wait(60 * minutes / len(ACTS))
            moved = [event["at"] for event in robot.base.seen(event="moves") if event["at"] > began]
            stood = max((later - earlier for earlier, later in pairwise(moved)), default=math.inf)
            quiet = Passage(Act(drives), stood, robot.lost(), robot.faults(), 0)
            robot.moves(time.monotonic())
            for passage in (quiet, robot.after(act)):
                broken += not passage.holds
                print(f"{passage}; load {os.getloadavg()[0]:.1f}", flush=True)
    return broken


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--trials", type=int, default=1000)
    arguments.add_argument("--silent", type=float, default=0.3)
    arguments.add_argument("--busy", action="store_true")
    arguments.add_argument("--drive", type=float, metavar="MINUTES")
    given = arguments.parse_args()
    if given.drive:
        sys.exit(drive(given.drive) > 0)
    with busy_programs(1 if given.busy else 0):
        rows = lateness(given.trials, given.silent)
    late = [row for row in rows if row is not None]
    cuts = statistics.quantiles(late, n=100)
    soon = sum(one <= ALLOWED for one in late)
    print(f"{len(late)} of {len(rows)} stopped, {soon} within {ALLOWED:g} ms of `silent`")
    print(f"late by 50 % {cuts[49]:.1f} ms, 99 % {cuts[98]:.1f} ms, {min(late):.1f} to {max(late):.1f} ms")


if __name__ == "__main__":
    main()
