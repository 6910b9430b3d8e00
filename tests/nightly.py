"""Run the lanes of the night that tests/lanes.toml lists: `make nightly` all, `make lane NAME=nodes` one.

A test that fails runs once more alone. If it passes then, it is printed as `flaky` and counted; if not, the run is red.
A lane ends after 45 minutes with a failure. `build/nightly/results.json` has passes, failures and seconds of each test,
and the commit, start, end and load average of each run. Runs of the same commit add up, and `make nightly` leaves out
the lanes that are green on it. `--record` writes them to `tests/green.json`, which `make release` reads.
"""

import argparse
import contextlib
import datetime
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
import tomllib
import xml.etree.ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tests.support.sources import ROOT

FOLDER = ROOT / "build" / "nightly"
RESULTS = FOLDER / "results.json"
GREEN = ROOT / "tests" / "green.json"
TABLE: dict[str, dict[str, Any]] = tomllib.loads((ROOT / "tests" / "lanes.toml").read_text(encoding="utf-8"))
# No test of a lane runs these. A release sets the version after the night.
_NOT_RUN = (
    ":!*.md",
    ":!docs",
    ":!benchmarks",
    ":!tests",
    ":!*/tests",
    ":!lab",
    ":!.ci",
    ":!appliance/__init__.py",
)
_LANE_SECONDS = 45 * 60.0
_END_SECONDS = 60.0  # for an interrupted run to write its report
_REMEDY = """Run `make lane NAME=…`, then `.venv/bin/python -m tests.nightly --record`, and commit tests/green.json.
To release nevertheless, give the reason: make release DESPITE="…"
"""
_MAX_AGAIN = 10  # more failures are not by chance


@dataclass(frozen=True)
class Lane:
    """A row of the table; `part` is `2/3` for the second of its three parts."""

    name: str
    tests: Sequence[str] = ()
    programs: Sequence[str] = ()
    product: str = "appliance"
    setup: str = ""
    workers: str = ""
    spread: bool = False
    timeout: int = 300
    parts: int = 1
    part: str = ""

    @property
    def row(self) -> str:
        return self.name.rpartition("-")[0] if self.part else self.name

    def options(self) -> list[str]:
        distribution = ("load",) if self.spread else ("loadfile", "--no-loadscope-reorder")
        options = ["-n", self.workers, "--dist", *distribution] if self.workers else []
        return [*options, *(["--part", self.part] if self.part else []), f"--timeout={self.timeout}"]


def lanes() -> dict[str, Lane]:
    found: dict[str, Lane] = {}
    for name, row in TABLE["lanes"].items():
        lane = Lane(name, **row)
        parts = range(1, lane.parts + 1) if lane.parts > 1 else ()
        split = [replace(lane, name=f"{name}-{part}", part=f"{part}/{lane.parts}") for part in parts] or [
            lane
        ]
        found |= {one.name: one for one in split}
    return found


def row_of_file(file: str) -> str:
    """Return the name of the row whose longest word the path begins with, or an empty one."""
    words = ((word, name) for name, row in TABLE["lanes"].items() for word in row.get("tests", ()))
    fitting = ((len(word), name) for word, name in words if file.startswith(word))
    return max(fitting, default=(0, ""))[1]


def every_file() -> list[str]:
    tops = ("tests", "rosmop", "fleet", "lab")
    return sorted(
        path.relative_to(ROOT).as_posix() for top in tops for path in (ROOT / top).rglob("test_*.py")
    )


def files_of(lane: Lane, words: Sequence[str] = ()) -> list[str]:
    mine = [file for file in every_file() if row_of_file(file) == lane.row]
    return [file for file in mine if not words or any(word in file for word in words)]


# Tests run programs of this checkout as other users. In a mount namespace of its own, an open folder with the same
# contents replaces each closed one above the checkout, and the command starts there: `sh -c … sh FOLDER… -- COMMAND…`.
_OPEN_FOLDERS = """
set -eu
kept=$(mktemp --directory)
while [ "$1" != -- ]; do
    mount --rbind "$1" "$kept"
    mount -t tmpfs -o mode=755 tmpfs "$1"
    find "$kept" -mindepth 1 -maxdepth 1 -printf '%f\\n' | while read -r name; do
        if [ -L "$kept/$name" ]; then cp --no-dereference "$kept/$name" "$1/"; continue; fi
        if [ -d "$kept/$name" ]; then mkdir "$1/$name"; else : > "$1/$name"; fi
        mount --rbind "$kept/$name" "$1/$name"
    done
    umount --lazy "$kept"
    shift
done
shift
exec "$@"
"""


def open_folders_above(checkout: Path) -> None:
    """Start this program again in a mount namespace where other users can reach the checkout, unless they can here."""
    closed = [
        str(folder) for folder in reversed(checkout.parents) if not folder.stat().st_mode & stat.S_IXOTH
    ]
    if not closed or os.geteuid() != 0:
        return
    again = [sys.executable, "-m", "tests.nightly", *sys.argv[1:]]
    command = ["unshare", "--mount", "sh", "-c", _OPEN_FOLDERS, "sh", *closed, "--", *again]
    os.chdir(checkout)
    os.execvp("unshare", command)  # noqa: S606  util-linux, and our own script


def outcomes_of(report: Path) -> Iterator[tuple[str, str, float]]:
    for case in xml.etree.ElementTree.parse(report).iter("testcase"):  # noqa: S314  written by pytest
        kinds = {child.tag for child in case}
        outcome = "failed" if kinds & {"failure", "error"} else "skipped" if "skipped" in kinds else "passed"
        yield f"{case.get('file')}::{case.get('name')}", outcome, float(case.get("time", 0))


def run_tests(
    lane: Lane, files: list[str], seconds: float
) -> tuple[list[tuple[str, str, float]], list[str], str]:
    """Return the outcome of each test, those that passed only when they ran again, and what else went wrong."""
    deadline = time.monotonic() + seconds
    report, log = FOLDER / f"{lane.name}.xml", FOLDER / f"{lane.name}.log"
    report.unlink(missing_ok=True)
    # The seeds of a night have its date, also in a test that runs again after midnight.
    day = os.environ.get("TESTS_DAY") or _moment()[:10]
    environment = {"TESTS_EXAMPLES": "all", "TESTS_PATIENCE": "2", "TESTS_DAY": day}
    pytest = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", "--rootdir=.", "--quiet", "--tb=short"]
    command = [*pytest, *files, *lane.options(), f"--junitxml={report}", "-o", "junit_family=xunit1"]
    status = run_limited(command, log, seconds, environment)
    outcomes = list(outcomes_of(report)) if report.exists() else []
    if status is None:
        return outcomes, [], f"not finished after {seconds / 60:.0f} minutes"
    failed = [test for test, outcome, _seconds in outcomes if outcome == "failed"]
    alone = [*pytest, *(["-n", "1"] if lane.workers else []), f"--timeout={lane.timeout}"]
    flaky: list[str] = []
    for number, test in enumerate(failed if len(failed) <= _MAX_AGAIN else (), 1):
        again, left = log.with_suffix(f".again-{number}.log"), deadline - time.monotonic()
        if left > 0 and run_limited([*alone, test], again, left, environment) == 0:
            flaky.append(test)
    explained = status in (0, 5) or (status == 1 and failed)
    return outcomes, flaky, "" if explained else f"pytest ended with status {status}"


def run_limited(
    command: Sequence[str],
    output: Path,
    seconds: float,
    environment: Mapping[str, str] | None = None,
) -> int | None:
    """Run a program and return its status, or None if it was interrupted after `seconds`.

    An interrupted pytest reports the tests that have ended. A minute later all processes of the program are killed, so
    that none disturbs the next lane.
    """
    with (
        output.open("wb") as log,
        subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | (environment or {}),
            stdout=log,
            stderr=log,
            start_new_session=True,
        ) as program,
    ):
        try:
            return program.wait(seconds)
        except subprocess.TimeoutExpired:
            program.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                program.wait(_END_SECONDS)
            return None
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(program.pid, signal.SIGKILL)


def run_programs(lane: Lane, seconds: float) -> tuple[list[tuple[str, str, float]], list[str]]:
    outcomes: list[tuple[str, str, float]] = []
    findings: list[str] = []
    for number, program in enumerate(lane.programs, 1):
        began, log = time.monotonic(), FOLDER / f"{lane.name}-{number}.log"
        status = run_limited([sys.executable, "-m", *program.split()], log, seconds / len(lane.programs))
        outcomes.append((program, "passed" if status == 0 else "failed", time.monotonic() - began))
        findings += findings_of(log.read_text(encoding="utf-8"))
    return outcomes, findings


def findings_of(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith("finding: ")]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--lane",
        choices=["names", "turn", *lanes()],
        help="run one; `turn`: that whose turn it is at this commit",
    )
    parser.add_argument(
        "--words", default="", help="run only the files whose path has one of these, by commas"
    )
    parser.add_argument("--record", action="store_true", help="write the green lanes to tests/green.json")
    parser.add_argument("--release", action="store_true", help="print which lane was green on which commit")
    parser.add_argument("--despite", default="", help="the reason to release although a lane is not green")
    given = parser.parse_args()
    if given.lane == "names":
        print("\n".join(lanes()))
    elif given.record:
        record(_earlier(_commit()))
    elif given.release:
        return release(json.loads(GREEN.read_text(encoding="utf-8")), given.despite)
    else:
        name = turn(int(_git("log", "-1", "--format=%ct"))) if given.lane == "turn" else given.lane
        return run(
            [lanes()[name]] if name else [*lanes().values()], given.words.split(",") if given.words else []
        )
    return 0


def run(asked: Sequence[Lane], words: Sequence[str]) -> int:
    results = _earlier(_commit())
    done = {
        name
        for name, row in results["green"].items()
        if row["commit"] == results["commit"] and len(asked) > 1
    }
    waiting = [lane for lane in asked if lane.name not in done and (files_of(lane, words) or not words)]
    for option in sorted({lane.setup for lane in waiting} - {""}):
        subprocess.run([ROOT / "scripts" / "setup", option], check=True)
    open_folders_above(ROOT)
    for end in (signal.SIGINT, signal.SIGTERM):  # a script's background process ignores SIGINT
        signal.signal(end, _end)
    FOLDER.mkdir(parents=True, exist_ok=True)
    print("lanes:", *(lane.name for lane in waiting), flush=True)
    namespaces = _namespaces()
    for lane in waiting:
        run_lane(lane, words, results)
    left = sorted(_namespaces() - namespaces)
    results["findings"] += [f"finding: new network namespaces: {', '.join(left)}"] if left else []
    runs = results["runs"][len(results["runs"]) - len(waiting) :]
    print(
        "\n".join(["", *(f"{name:<16} was green" for name in done), *map(row_of, runs), *results["findings"]])
    )
    if len(runs) == 1 and runs[0]["failed"]:  # CI keeps no file
        for log in sorted(FOLDER.glob(f"{runs[0]['lane']}*.log")):
            print(f"\n{log}:", log.read_text(encoding="utf-8", errors="replace")[-20_000:])
    print("\n".join([*(f"FAILED {test}" for one in runs for test in one["failed"]), f"results: {RESULTS}"]))
    return int(any(one["failed"] for one in runs))


def _end(number: int, _frame: object) -> None:
    sys.exit(128 + number)  # `run_limited` ends the lane's processes


def run_lane(lane: Lane, words: Sequence[str], results: dict[str, Any]) -> None:
    began, clock, load = _moment(), time.monotonic(), os.getloadavg()[0]
    findings, flaky, wrong = list[str](), list[str](), ""
    if lane.programs:
        outcomes, findings = run_programs(lane, _LANE_SECONDS)
    else:
        outcomes, flaky, wrong = run_tests(lane, files_of(lane, words), _LANE_SECONDS)
    failed = [test for test, outcome, _ in outcomes if outcome == "failed" and test not in flaky]
    this = {
        "lane": lane.name,
        "words": [*words],
        "began": began,
        "ended": _moment(),
        "minutes": round((time.monotonic() - clock) / 60, 1),
        "load": [load, *os.getloadavg()[:1]],
        "free_gigabytes": shutil.disk_usage(ROOT).free >> 30,
        "passed": sum(1 for _, outcome, _ in outcomes if outcome == "passed"),
        "skipped": sum(1 for _, outcome, _ in outcomes if outcome == "skipped"),
        "flaky": flaky,
        "failed": failed + ([f"{lane.name}: {wrong} ({FOLDER}/{lane.name}.log)"] if wrong else []),
    }
    _add(results["tests"], outcomes + [(test, "passed", 0.0) for test in flaky])
    results["findings"] += findings
    results["runs"].append(this)
    if not words and not results["commit"].endswith("-dirty") and _commit() == results["commit"]:
        green = {key: this[key] for key in ("ended", "passed", "skipped", "flaky")}
        results["green"][lane.name] = {"commit": results["commit"]} | green
        if this["failed"] or not this["passed"]:
            del results["green"][lane.name]
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print("\n".join([*findings, *(f"flaky {test}" for test in flaky), row_of(this)]), flush=True)


def _namespaces() -> set[str]:
    folder = Path("/run/netns")
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def row_of(run: Mapping[str, Any]) -> str:
    counts = f"{run['passed']:>6} passed {len(run['failed']):>4} failed {len(run['flaky']):>4} flaky"
    return (
        f"{run['lane']:<16}{run['minutes']:>6.1f} min {counts} {run['skipped']:>4} skipped"
        f"  {run['free_gigabytes']} GB free"
    )


def _add(tests: dict[str, Any], outcomes: list[tuple[str, str, float]]) -> None:
    for name, outcome, seconds in outcomes:
        row = tests.setdefault(name, {"passed": 0, "failed": 0, "skipped": 0, "seconds": []})
        row[outcome] += 1
        row["seconds"].append(round(seconds, 3))


def turn(moment: int) -> str:
    names = [*lanes()]
    return names[moment // 60 % len(names)]


def record(results: Mapping[str, Any]) -> None:
    known = json.loads(GREEN.read_text(encoding="utf-8")) | results["green"]
    GREEN.write_text(json.dumps({name: known[name] for name in lanes() if name in known}, indent=1) + "\n")


def release(green: Mapping[str, Mapping[str, Any]], reason: str) -> int:
    """Print the commit of each lane, and the files that differ now. Without a reason, these are an error."""
    stale: list[str] = []
    for name, lane in lanes().items():
        row = green.get(name)
        later = changed_since(lane, row["commit"]) if row else []
        words = " ".join(f"{key} {value or 'none'}," for key, value in (row or {}).items()).rstrip(",")
        print(f"{name}: {words or 'was not green'}")
        print("".join(f"  changed since: {file}\n" for file in later), end="")
        changed = (
            f"{', '.join(later[:3])}{', …' * bool(later[3:])} changed since {row['commit']}" if row else ""
        )
        stale += [f"  {name}: {changed or 'it was not green'}"] if later or not row else []
    if stale and reason:
        print(f"released although these lanes were not green on it: {reason}", *stale, sep="\n")
    elif stale:
        sys.stderr.write(
            "\n".join(("release: these lanes of the night were not green on it:", *stale, _REMEDY))
        )
    return int(bool(stale and not reason))


def changed_since(lane: Lane, commit: str) -> list[str]:
    """Return the files that a lane's tests import or run and that differ between a commit and this one."""
    own = [*(f"{word}*" for word in lane.tests), "conftest.py", "tests/conftest.py", "tests/support"]
    own += ["benchmarks"] if lane.programs else []
    parts = [*TABLE["products"][lane.product]["files"], *_NOT_RUN], own
    try:
        found = [_git("diff", "--name-only", commit, "HEAD", "--", *part) for part in parts]
    except subprocess.CalledProcessError:
        return ["(this clone lacks the commit: all)"]
    return "\n".join(found).split()


def _earlier(commit: str) -> dict[str, Any]:
    """Return the results of earlier runs of a commit, and the newest green run of each lane, of any commit."""
    fresh = {"commit": commit, "runs": [], "tests": {}, "findings": [], "green": {}}
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else fresh
    return fresh | (kept if kept["commit"] == commit else {"green": kept.get("green", {})})


def _commit() -> str:
    return _git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def _moment() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


if __name__ == "__main__":
    sys.exit(main())
