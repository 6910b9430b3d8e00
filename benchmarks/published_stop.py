"""Time until a stop that a monitor publishes is sent: python -m benchmarks.published_stop [--deployed] [--stops 400]

The time is from the arrival of a scan with a near obstacle at the monitors until the relay has the zero velocity to
send, without sockets. With `--deployed`, it is from one rospy node's `publish` to another's callback at a running
appliance, and changed commands take turns with the stops; the nodes have real-time priority if permitted. With
`--busy`, two programs for each core keep it busy.
"""

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.cold import realtime
from benchmarks.relay_throughput import HERE
from rosmop.tests.acting import message
from tests.support.appliance import Appliance
from tests.support.nodes import PYTHON, RosSession
from tests.unit.relay.monitors.quiet import QuietMonitors

STOP = """stop() { geometry_msgs::Twist zero; bool near;
    event scan(std::vector<float> ranges) /scan sensor_msgs/LaserScan '{ranges:ranges}' {
        near = ranges.size() > 0 && ranges[0] < 0.5;
        if (near) { ROS_WARN("obstacle at %f", ranges[0]); PUBLISH(/cmd_vel, geometry_msgs/Twist, zero); } } }"""
SILENT_STOP = STOP.replace('ROS_WARN("obstacle at %f", ranges[0]);', "")
CAP = """cap() {
    event drive(double x) /drive geometry_msgs/Twist '{linear:{x:x}}' { if (x > 1.0) { x = 1.0; } } }"""
NEAR = message("sensor_msgs/LaserScan", ranges=[0.1] * 40)


def alone(stops: int) -> dict[str, list[float]]:
    sent: list[int] = []
    monitors = QuietMonitors(lambda _topic, _data: sent.append(time.perf_counter_ns()))
    monitors.load(STOP)
    took = []
    for number in range(stops):
        if not number % 20:
            monitors.interceptor.tick()  # a new second: the next report is in full
        time.sleep(0.007)  # noqa: TID251  lets caches become cold, as between two scans
        began = time.perf_counter_ns()
        monitors.process("/scan", NEAR, number * 10_000_000 + 1)
        took.append((sent[-1] - began) / 1e6)
    return {"published stop": took}


def deployed(stops: int) -> dict[str, list[float]]:
    monitors = {"stop": SILENT_STOP, "cap": CAP}
    with (
        Appliance(monitors=monitors, options=("--api", "127.0.0.1:0")) as appliance,
        tempfile.TemporaryDirectory() as home,
        RosSession(appliance.master_uri, Path(home)) as session,
    ):
        node = session.start([*realtime(), PYTHON, str(HERE / "nodes" / "stopped_node.py"), str(stops)])
        measured = node.wait_for(event="measured", timeout=120 + stops)
    return {"changed command": measured["took"]["/drive"], "published stop": measured["took"]["/scan"]}


@contextlib.contextmanager
def busy_programs(number: int) -> Iterator[None]:
    command = [sys.executable, "-c", "while True: pass"]
    programs = [subprocess.Popen(command, start_new_session=True) for _ in range(number)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--stops", type=int, default=400)
    arguments.add_argument("--deployed", action="store_true")
    arguments.add_argument("--busy", action="store_true")
    given = arguments.parse_args()
    with busy_programs(2 * (os.cpu_count() or 1) if given.busy else 0):
        rows = (deployed if given.deployed else alone)(given.stops)
    for name, took in rows.items():
        cuts = statistics.quantiles(took, n=100)
        print(f"{name}: 50 % {cuts[49]:.2f} ms, 90 % {cuts[89]:.2f} ms, 99 % {cuts[98]:.2f} ms")


if __name__ == "__main__":
    main()
