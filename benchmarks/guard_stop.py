"""Time until the guard `deadman` stops a base whose operator falls silent: python -m benchmarks.guard_stop [--busy]

A rospy node commands full speed 50 times a second, and falls silent. The time is from its last call of `publish`
until the base's callback for the stop, minus the guard's `silent`. With `--busy`, another program keeps a core busy.
"""

import argparse
import statistics
import tempfile
from pathlib import Path

from appliance.features.guards.presets import PRESETS, Guard, text_of
from benchmarks.cold import realtime
from benchmarks.published_stop import busy_programs
from benchmarks.relay_throughput import HERE
from tests.support.appliance import Appliance
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


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--trials", type=int, default=1000)
    arguments.add_argument("--silent", type=float, default=0.3)
    arguments.add_argument("--busy", action="store_true")
    given = arguments.parse_args()
    with busy_programs(1 if given.busy else 0):
        rows = lateness(given.trials, given.silent)
    late = [one for one in rows if one is not None]
    cuts = statistics.quantiles(late, n=100)
    soon = sum(one <= ALLOWED for one in late)
    print(f"{len(late)} of {len(rows)} stopped, {soon} within {ALLOWED:g} ms of `silent`")
    print(f"late by 50 % {cuts[49]:.1f} ms, 99 % {cuts[98]:.1f} ms, {min(late):.1f} to {max(late):.1f} ms")


if __name__ == "__main__":
    main()
