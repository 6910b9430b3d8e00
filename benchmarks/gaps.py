"""Seconds without messages after a relay's death and a restart: python -m benchmarks.gaps [--deaths D] [--restarts R]

One rospy node publishes 100 messages a second to another. The relay of `rosrv up` is killed (SIGKILL) again and
again, then the whole appliance is restarted. Each time, the longest gap between two messages counts.
"""

import argparse
import os
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.relay_throughput import HERE
from tests.support.appliance import Appliance
from tests.support.nodes import PYTHON, RosSession
from tests.support.processes import Process
from tests.support.rosmaster import free_port

_RATE = 100
_LIMIT = 120.0  # seconds until messages count as lost for ever
_SETTLED = 11.0  # seconds: a process that dies within ten seconds of its start waits before the next one


def longest_gap(listener: Process, fault: Callable[[], object]) -> float:
    seen, began = len(listener.events), time.monotonic()
    fault()
    listener.wait_for(lambda event: event["ended"] > began, since=seen, event="gap", timeout=_LIMIT)
    time.sleep(_SETTLED)  # noqa: TID251  nothing happens if there is no further gap
    return max(float(event["ended"]) - float(event["began"]) for event in listener.events[seen:])


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--deaths", type=int, default=20)
    arguments.add_argument("--restarts", type=int, default=5)
    given = arguments.parse_args()
    options = ("--api", "off", "--listen", f"127.0.0.1:{free_port()}")
    with (
        Appliance(options=options) as appliance,
        tempfile.TemporaryDirectory() as home,
        RosSession(appliance.master_uri, Path(home)) as session,
    ):
        listener = session.start([PYTHON, str(HERE / "nodes" / "gap_node.py"), "/drive"])
        session.talker("rospy", "/drive", "--rate", str(_RATE))
        listener.wait_for(event="first", timeout=_LIMIT)

        def kill() -> None:
            [pid] = appliance.pids("relay")
            os.kill(pid, signal.SIGKILL)

        def restart() -> None:
            appliance.stop()
            appliance.start()

        for name, number, fault in (
            ("relay killed", given.deaths, kill),
            ("restart", given.restarts, restart),
        ):
            gaps = []
            for _ in range(number):
                gaps.append(longest_gap(listener, fault))
                print(f"{name}: {gaps[-1]:.2f} s", flush=True)
            if gaps:
                print(
                    f"{name}: {number} times, median {statistics.median(gaps):.2f} s, worst {max(gaps):.2f} s"
                )


if __name__ == "__main__":
    main()
