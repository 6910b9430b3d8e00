"""Run a test many times beside busy loops: `make steady TEST=path N=50`.

It prints the number of failures, and the largest probability of failure that is compatible with it (95 % confidence).
"""

import argparse
import math
import os
import subprocess
import sys
from pathlib import Path

from tests.support.sources import ROOT


def largest_chance(failures: int, runs: int, confidence: float = 0.95) -> float:
    """Return Clopper and Pearson's upper bound, which is about 3/n without a failure."""
    low, high = failures / runs, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        at_most = sum(
            math.comb(runs, k) * middle**k * (1 - middle) ** (runs - k) for k in range(failures + 1)
        )
        low, high = (middle, high) if at_most > 1 - confidence else (low, middle)
    return high


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("test", help="a file or id for pytest")
    parser.add_argument("runs", type=int, help="how often to run it")
    given = parser.parse_args()
    logs = ROOT / "build" / "steady"
    logs.mkdir(parents=True, exist_ok=True)
    # The kernel ends the loops with this program, however that ends.
    busy = ["setpriv", "--pdeathsig", "KILL", "sh", "-c", "while :; do :; done"]
    loops = [subprocess.Popen(busy) for _ in range(os.cpu_count() or 1)]
    try:
        failed = [number for number in range(1, given.runs + 1) if _fails(given.test, logs / f"{number}.log")]
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    for number in failed:
        print(f"run {number} failed: build/steady/{number}.log")
    bound = largest_chance(len(failed), given.runs)
    print(
        f"{len(failed)} of {given.runs} runs failed; the chance of a failure is at most {bound:.1%} (95 % confidence)"
    )
    return int(bool(failed))


def _fails(test: str, log: Path) -> bool:
    command = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", test, "--quiet"]
    with log.open("wb") as file:
        return subprocess.run(command, cwd=ROOT, stdout=file, stderr=file, check=False).returncode != 0


if __name__ == "__main__":
    sys.exit(main())
