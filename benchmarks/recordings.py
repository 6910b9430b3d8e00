"""Throughput and memory of `rosmop run` over many recordings: one process against two, and short against long.

    python -m benchmarks.recordings

Each pair runs both numbers of workers, in alternating order, on the same recordings. Its efficiency is the ratio of
their throughputs divided by the number of workers. Two commands with half of the recordings each, at the same time
and without a pool, show the efficiency that the machine allows. Processor time does not depend on other programs.
"""

import argparse
import os
import random
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rosbags.rosbag1 import Writer

from roswire.standard import standard_definitions

SPECIFICATION = """
limit() {
    event drive(double forward) /cmd_vel geometry_msgs/Twist '{linear:{x:forward}}' { if (forward > 2.9) return; }
    event silent() every 1s { }
    ere: (drive silent | silent)* drive drive @match { }
}
"""
TWIST, TEXT = "geometry_msgs/Twist", "std_msgs/String"
# ru_maxrss would include the memory of the process that started this one.
PROGRAM = """
import atexit, sys
from pathlib import Path
from rosmop.tool.command import app
atexit.register(lambda: sys.stderr.write(Path("/proc/self/status").read_text()))
app()
"""


def make(path: Path, seed: int, seconds: int, payload: int) -> None:
    known, chance = standard_definitions(), random.Random(seed)
    with Writer(path) as writer:
        rows = [
            writer.add_connection(
                topic, kind.replace("/", "/msg/"), msgdef=known.full_text(kind), md5sum=known.md5sum(kind)
            )
            for topic, kind in (("/cmd_vel", TWIST), ("/payload", TEXT))
        ]
        for number in range(seconds * 50):
            now = 1_700_000_000 * 10**9 + number * 20_000_000
            writer.write(rows[0], now, struct.pack("<6d", chance.gauss(0, 1), 0, 0, 0, 0, 0))
            writer.write(rows[1], now, struct.pack("<I", payload) + bytes(payload))


def processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(folder: Path, recordings: str, workers: int) -> tuple[float, int]:
    """Return the seconds, and the largest memory of the first process in bytes."""
    command = [
        sys.executable,
        "-c",
        PROGRAM,
        "run",
        "limit.rv",
        "--bags",
        recordings,
        "--workers",
        str(workers),
    ]
    begin = time.perf_counter()
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    taken = time.perf_counter() - begin
    (most,) = [line.split()[1] for line in done.stderr.splitlines() if line.startswith("VmHWM")]
    return taken, int(most) * 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--recordings", type=int, default=16)
    parser.add_argument("--seconds", type=int, default=3000, help="length of a recording")
    parser.add_argument("--payload", type=int, default=1000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "limit.rv").write_text(SPECIFICATION)
        (folder / "many").mkdir()
        for seed in range(options.recordings):
            make(folder / "many" / f"{seed}.bag", seed, options.seconds, options.payload)
        size = sum(path.stat().st_size for path in (folder / "many").iterdir())
        print(f"{options.recordings} recordings, {size / 1e6:.0f} MB; load {os.getloadavg()[0]:.1f}")
        efficiencies = []
        for pair in range(options.pairs):
            order = (1, 2) if pair % 2 == 0 else (2, 1)
            seconds, used = {}, {}
            for workers in order:
                before = processor_time()
                seconds[workers] = run(folder, "many", workers)[0]
                used[workers] = processor_time() - before
            with ThreadPoolExecutor(2) as both:
                begin = time.perf_counter()
                list(both.map(lambda half: run(folder, f"many/*[{half}].bag", 1), ("02468", "13579")))
                apart = time.perf_counter() - begin
            efficiencies.append(seconds[1] / seconds[2] / 2)
            rates = ", ".join(
                f"{workers}: {options.recordings / taken:.2f} recordings/s, {size / taken / 1e6:.1f} MB/s"
                for workers, taken in sorted(seconds.items())
            )
            print(
                f"{rates}; efficiency {efficiencies[-1]:.2f} (apart {seconds[1] / apart / 2:.2f}); "
                f"processor {used[1]:.1f} s, {used[2]:.1f} s; load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
        print(f"median efficiency {statistics.median(efficiencies):.2f}")
        for seconds_long in (60, 600, 6000):
            make(folder / f"{seconds_long}.bag", 1, seconds_long, options.payload)
            memory = run(folder, f"{seconds_long}.bag", 1)[1]
            length = (folder / f"{seconds_long}.bag").stat().st_size
            print(
                f"memory: {length / 1e6:.0f} MB, {seconds_long * 100} messages: {memory / 2**20:.0f} MiB",
                flush=True,
            )


if __name__ == "__main__":
    main()
