"""Time until a relay sends a stop that a monitor publishes: python -m benchmarks.published_stop [--stops 400]

A scan with a near obstacle arrives alone, some milliseconds after the one before it. The monitor prints a warning and
publishes a zero velocity. The measured time is from the arrival of the scan at the monitors until the relay has the
zero velocity to send, without sockets.
"""

import argparse
import statistics
import time

from rosmop.tests.acting import message
from tests.unit.relay.monitors.quiet import QuietMonitors

STOP = """stop() { geometry_msgs::Twist zero; bool near;
    event scan(std::vector<float> ranges) /scan sensor_msgs/LaserScan '{ranges:ranges}' {
        near = ranges.size() > 0 && ranges[0] < 0.5;
        if (near) { ROS_WARN("obstacle at %f", ranges[0]); PUBLISH(/cmd_vel, geometry_msgs/Twist, zero); } } }"""
NEAR = message("sensor_msgs/LaserScan", ranges=[0.1] * 40)


def main() -> None:
    """Print the median and the 99th percentile."""
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--stops", type=int, default=400)
    stops = arguments.parse_args().stops
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
        took.append((sent[-1] - began) / 1e3)
    cuts = statistics.quantiles(took, n=100)
    print(f"published stop: {cuts[49]:.0f} µs, 99 %: {cuts[98]:.0f} µs")


if __name__ == "__main__":
    main()
