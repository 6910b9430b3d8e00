"""Run guards in simulated worlds, and report each law that is broken.

python -m tests.world.closed_loop --worlds 100000 --seed 1 --jobs 2    run many worlds, as many for each preset
python -m tests.world.closed_loop --replay PRESET SEED                 run one world, with everything that happens in it
python -m tests.world.closed_loop --join A.json B.json --json C.json   add runs of one commit, with seeds that follow
"""

import argparse
import datetime
import json
import multiprocessing
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from appliance.features.guards.evidence import text_digest
from appliance.features.guards.presets import PRESETS
from tests.world.closed_loop.worlds import PAIRS, WORLDS, Summary, replay, run_chunk, run_one

_AT_ONCE = 50


def _chunks(presets: list[str], worlds: int, first: int) -> Iterator[tuple[str, int, int]]:
    each = -(-worlds // len(presets))
    for begin in range(0, each, _AT_ONCE):
        for preset in presets:
            yield preset, first + begin, first + min(each, begin + _AT_ONCE)


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")


def _as_data(first: int, summaries: dict[str, Summary]) -> dict[str, object]:
    commit = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
    )
    return {
        "commit": commit.stdout.strip(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "first_seed": first,
        "presets": {
            preset: {"digest": text_digest(PRESETS[preset].text), **_result(one)}
            for preset, one in summaries.items() if preset != PAIRS
        },
        PAIRS: _result(summaries[PAIRS]) if PAIRS in summaries else None,
    }  # fmt: skip


def _result(one: Summary) -> dict[str, object]:
    return {
        "worlds": one.worlds,
        "seconds": round(one.seconds),
        "closest": round(one.clearance, 4) if one.clearance < float("inf") else None,
        "violations": dict(one.violations),
    }


def joined(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the sum of runs of one commit, each with the seeds that follow those of the run before it."""
    first = runs[0]
    for key in ("commit", "presets"):
        kept = [_fixed(one, key) for one in runs]
        if any(one != kept[0] for one in kept):
            raise ValueError(f"the runs differ in {key}, so they are not one run")
    seed = first["first_seed"]
    for one in runs:
        if one["first_seed"] != seed:
            raise ValueError(f"a run begins with the seed {one['first_seed']}, not with {seed}")
        [count] = {row["worlds"] for row in _rows(one).values()}
        seed += count
    return {
        **first,
        "date": runs[-1]["date"],
        "presets": {name: _sum([one["presets"][name] for one in runs]) for name in first["presets"]},
        PAIRS: _sum([one[PAIRS] for one in runs]) if first[PAIRS] else None,
    }


def corrected(run: dict[str, Any], again: dict[str, Any]) -> dict[str, Any]:
    """Return `run` with the rows of `again`, which ran the same worlds later, after a correction of the rig."""
    rows, later = _rows(run), _rows(again)
    for name, row in later.items():
        if any(row.get(key) != rows[name].get(key) for key in ("digest", "worlds")):
            raise ValueError(f"the later run of {name} has other worlds, or another text")
    if again["first_seed"] != run["first_seed"]:
        raise ValueError("the later run begins with another seed")
    told = {name: {**row, "commit": again["commit"]} for name, row in later.items()}
    pairs = told.pop(PAIRS, run[PAIRS])
    return {**run, "presets": {**run["presets"], **told}, PAIRS: pairs}


def _fixed(run: dict[str, Any], key: str) -> Any:
    return run[key] if key == "commit" else {name: row["digest"] for name, row in run["presets"].items()}


def _rows(run: dict[str, Any]) -> dict[str, Any]:
    return {**run["presets"], **({PAIRS: run[PAIRS]} if run[PAIRS] else {})}


def _sum(rows: list[dict[str, Any]]) -> dict[str, Any]:
    near = [one["closest"] for one in rows if one["closest"] is not None]
    broken: Counter[str] = Counter()
    for one in rows:
        broken.update(one["violations"])
    return {
        **rows[0],
        "worlds": sum(one["worlds"] for one in rows),
        "seconds": sum(one["seconds"] for one in rows),
        "closest": min(near, default=None),
        "violations": dict(broken),
    }


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.world.closed_loop", description=(__doc__ or "").partition("\n")[0]
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
        "--again",
        type=Path,
        help="with --join: the same worlds of some presets, run after a correction of the rig",
    )
    chosen = parser.parse_args(arguments)
    if chosen.join:
        if not chosen.json:
            parser.error("--join needs --json FILE for the sum")
        runs = sorted((json.loads(one.read_text()) for one in chosen.join), key=itemgetter("first_seed"))
        run = joined(runs)
        if chosen.again:
            run = corrected(run, json.loads(chosen.again.read_text()))
        chosen.json.write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")
        return 0
    if chosen.replay:
        preset, seed = chosen.replay
        report = run_one(preset, int(seed), trace=_print, alone=chosen.alone)
        return 1 if report.violations else 0
    presets = chosen.preset or [*WORLDS, PAIRS]
    summaries = {preset: Summary() for preset in presets}
    with multiprocessing.get_context("spawn").Pool(chosen.jobs) as pool:
        for preset, found in pool.imap_unordered(run_chunk, _chunks(presets, chosen.worlds, chosen.seed)):
            summaries[preset].join(found)
            for seed, text in found.broken:
                sys.stdout.write(f"{preset} {seed}: {text}\n    {replay(preset, seed)}\n")
                sys.stdout.flush()
    for preset, one in summaries.items():
        sys.stdout.write(f"{preset}: {one}\n")
    if chosen.json:
        chosen.json.write_text(
            json.dumps(_as_data(chosen.seed, summaries), indent=1) + "\n", encoding="utf-8"
        )
    return 1 if any(one.broken for one in summaries.values()) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
