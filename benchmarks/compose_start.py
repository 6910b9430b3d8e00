"""Measure the time from `docker compose up` until nodes may connect, the time of `stop`, and the image's size.

    python -m benchmarks.compose_start [RUNS]

Needs root and an otherwise idle machine. Only the first start makes the volume, the keys and the log.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

from examples.landshark.lab import Lab
from tests.support.docker import APPLIANCE, BASE, DEMO, Compose, Engine, build_images, project

RUNS = 5
READY = "Nodes may connect"


def start(compose: Compose) -> tuple[float, float]:
    """Return the seconds until nodes may connect, and until the container counts as healthy."""
    moment = compose.engine.docker("info", "--format", "{{.SystemTime}}").stdout.strip()
    begun = time.perf_counter()
    compose("up", "--detach", "--no-build")
    compose.wait_for_log("appliance", READY, since=moment)
    ready = time.perf_counter() - begun
    compose.wait_healthy()
    return ready, time.perf_counter() - begun


def stop(compose: Compose) -> float:
    begun = time.perf_counter()
    compose("stop")
    return time.perf_counter() - begun


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    build_images()
    with Lab("rosrv-bench") as lab, Engine(lab.host("machine", "10.79.0.1/24")) as engine:
        sizes = {name: int(engine.inspect(name)["Size"]) / 1e6 for name in (BASE, APPLIANCE, DEMO)}
        with tempfile.TemporaryDirectory() as directory:
            compose = engine.compose(project(Path(directory)), "bench")
            try:
                first, _ = start(compose)
                stops, readies, healthies = [stop(compose)], [], []
                for _ in range(runs):
                    ready, healthy = start(compose)
                    readies.append(ready)
                    healthies.append(healthy)
                    stops.append(stop(compose))
            finally:
                compose("down", "--volumes")
    print(
        f"image of the appliance       {sizes[APPLIANCE]:6.0f} MB, {sizes[APPLIANCE] - sizes[BASE]:.0f} beside the base"
    )
    print(f"first up to nodes may connect {first:5.1f} s")
    print(f"later ones, median of {runs:<2}      {statistics.median(readies):5.1f} s")
    print(f"until healthy, median        {statistics.median(healthies):6.1f} s (looked at every 5 s)")
    print(f"stop, median                 {statistics.median(stops):6.1f} s")


if __name__ == "__main__":
    main()
