"""Run guards in simulated worlds, and report each law that is broken.

python -m lab.closed_loop --worlds 100000 --seed 1 --jobs 2    run many worlds, as many for each preset
python -m lab.closed_loop --replay PRESET SEED                 run one world, with everything that happens in it
python -m lab.closed_loop --continue C.json --worlds 10000     run the seeds that follow those in a file, and add them
python -m lab.closed_loop --join A.json B.json --json C.json   add runs with seeds that follow, of any commits
"""

import argparse
import datetime
import json
import multiprocessing
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from lab.closed_loop.results import (
    Rows,
    as_data,
    continue_rows,
    correct_rows,
    join_runs,
    parse_rows,
    present_digests,
    rows_of,
)
from lab.closed_loop.worlds import PAIRS, WORLDS, Summary, replay, run_chunk, run_one

_AT_ONCE = 50


def _chunks(firsts: Mapping[str, int], worlds: int) -> Iterator[tuple[str, int, int]]:
    each = -(-worlds // len(firsts))
    for begin in range(0, each, _AT_ONCE):
        for preset, first in firsts.items():
            yield preset, first + begin, first + min(each, begin + _AT_ONCE)


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")


def _commit() -> str:
    found = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
    )
    return found.stdout.strip()


def _write(path: Path, rows: Rows) -> None:
    path.write_text(json.dumps(as_data(rows), indent=1) + "\n", encoding="utf-8")


def _read(path: Path) -> Rows:
    return parse_rows(json.loads(path.read_text(encoding="utf-8")))


def _join(files: list[Path], again: Path | None, to: Path) -> int:
    try:
        rows, left_out = join_runs([_read(file) for file in files], present_digests())
        if again:
            rows = correct_rows(rows, _read(again))
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    _write(to, rows)
    for one in left_out:
        _print(f"left out: {one}")
    for name, row in rows.items():
        _print(f"{name}: {row.worlds} worlds from seed {row.first_seed}, next seed {row.next_seed}")
    return 0


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m lab.closed_loop", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument(
        "--worlds", type=int, default=1000, help="the number of worlds (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="the first seed (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="the number of processes (default: %(default)s)")
    parser.add_argument(
        "--preset", action="append", choices=[*WORLDS, PAIRS], help="only this preset; may be repeated"
    )
    parser.add_argument("--json", type=Path, help="write the summary to this file")
    parser.add_argument(
        "--replay", nargs=2, metavar=("PRESET", "SEED"), help="run one world, and print all that happens"
    )
    parser.add_argument(
        "--alone", default="", metavar="TOPIC", help="with --replay: where a second node publishes alone"
    )
    parser.add_argument("--join", nargs="+", type=Path, help="add these runs, instead of running worlds")
    parser.add_argument(
        "--continue", dest="rows", type=Path, metavar="FILE",
        help="run the seeds that follow those of this file, from --seed on where a text is new, and add them there",
    )  # fmt: skip
    parser.add_argument(
        "--again",
        type=Path,
        help="with --join: the same worlds of some presets, run after a correction of the rig",
    )
    chosen = parser.parse_args(arguments)
    if chosen.join:
        if not chosen.json:
            parser.error("--join needs --json FILE for the sum")
        return _join(chosen.join, chosen.again, chosen.json)
    if chosen.replay:
        preset, seed = chosen.replay
        report = run_one(preset, int(seed), trace=_print, alone=chosen.alone)
        return 1 if report.violations else 0
    presets = chosen.preset or [*WORLDS, PAIRS]
    before, digests = _read(chosen.rows) if chosen.rows else {}, present_digests()
    firsts = {
        preset: before[preset].next_seed
        if preset in before and before[preset].digest == digests[preset]
        else chosen.seed
        for preset in presets
    }
    summaries = {preset: Summary() for preset in presets}
    with multiprocessing.get_context("spawn").Pool(chosen.jobs) as pool:
        for preset, found in pool.imap_unordered(run_chunk, _chunks(firsts, chosen.worlds)):
            summaries[preset].join(found)
            for seed, text in found.broken:
                sys.stdout.write(f"{preset} {seed}: {text}\n    {replay(preset, seed)}\n")
                sys.stdout.flush()
    for preset, one in summaries.items():
        sys.stdout.write(f"{preset}: {one}\n")
    if to := chosen.rows or chosen.json:
        date = datetime.datetime.now(datetime.UTC).date().isoformat()
        _write(to, continue_rows(before, rows_of(summaries, firsts, _commit(), date)))
    return 1 if any(summary.broken for summary in summaries.values()) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
