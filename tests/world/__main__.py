"""Replay histories of the world, and search for seeds that break a promise.

python -m tests.world --seed N                  replay one seed, with each of its events
python -m tests.world --first N --seeds COUNT   run this many seeds; print those that break a promise
"""

import argparse
import os
import sys
import time

from tests.world.loop import BrokenPromiseError
from tests.world.pair import PairWorld
from tests.world.world import World, run


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.world", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--seed", type=int, help="replay this seed, with each of its events")
    parser.add_argument("--first", type=int, default=0, help="the first seed (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=200, help="the number of seeds (default: %(default)s)")
    parser.add_argument("--pair", action="store_true", help="two appliances and a witness")
    chosen = parser.parse_args(arguments)
    kind = PairWorld if chosen.pair else World
    if chosen.seed is not None:
        run(chosen.seed, lambda line: sys.stdout.write(f"{line}\n"), kind)
        return 0
    broken, began = 0, time.process_time()
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        try:
            run(seed, kind=kind)
        except BrokenPromiseError as error:
            broken += 1
            sys.stdout.write(f"seed {seed}: {error}\n")
    seconds = time.process_time() - began
    sys.stdout.write(f"{chosen.seeds} seeds, {broken} broke a promise, {seconds:.1f} s\n")
    return min(broken, 1)


if __name__ == "__main__":
    if os.environ.get("PYTHONHASHSEED") != "0":  # sets of strings have another order in each process
        os.environ["PYTHONHASHSEED"] = "0"
        os.execv(sys.executable, [sys.executable, "-m", "tests.world", *sys.argv[1:]])  # noqa: S606  this program again
    sys.exit(main(sys.argv[1:]))
