"""Run all tests and report each: `make nightly`, or the tests of one lane, `make nightly LANE=standby`.

It never stops at a failure. `build/nightly/results.json` has passes, failures and seconds of each test, and the
commit, start, end and load average of each run. Runs of the same commit add up. If a robot's start
(`benchmarks/launch.py`) or the delay of a lone message (`benchmarks/cold.py`) differs by more than 20 % from the
table in `benchmarks/RESULTS.md`, that is printed as a finding. The exit status is 1 if a test failed that
`tests/unsteady.txt` does not list, or if one of these programs failed.
"""

import argparse
import datetime
import json
import os
import stat
import subprocess
import sys
import xml.etree.ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.sources import ROOT

FOLDER = ROOT / "build" / "nightly"
RESULTS = FOLDER / "results.json"
_LONE = ("benchmarks.cold", "--ordinary", "--findings", "--modes", "paced100,paced1000", "--rounds", "8")
MEASUREMENTS = {
    "start": ("benchmarks.launch",),
    "lone message": _LONE,
    "lone message, busy": (*_LONE, "--busy"),
}
UNSTEADY = ROOT / "tests" / "unsteady.txt"
_STAGE_SECONDS = 90 * 60.0  # a stage that hangs ends, and counts as failed

LANES = {
    "console": ("tests/system/console/",),
    "packages": (
        "tests/package/",
        "tests/smoke/",
        "tests/system/containers/",
        "tests/system/vm/",
        "tests/unit/distribution/",
    ),
    "standby": ("standby", "two_appliances", "lease", "insertion_at_large"),
    "fleet": ("fleet", "bundle", "collector", "rollout"),
    "recorder": ("recorder", "evidence", "recording"),
    "language": ("rosmop/", "tests/proofs/", "monitor", "specification", "compiler"),
}
"""Words of each lane. A file is in the first lane with a word that its path contains, and otherwise in `core`."""


@dataclass(frozen=True)
class Stage:
    """Tests that run side by side on `workers` of pytest-xdist, or one after the other."""

    name: str
    folders: tuple[str, ...]
    workers: str = ""

    def options(self) -> list[str]:
        return ["-n", self.workers, "--dist", "loadfile", "--no-loadscope-reorder"] if self.workers else []


# A worker has no network but a loopback of its own, so tests that fetch packages run without workers, as do those that
# start many processes themselves.
STAGES = (
    Stage("computing", ("tests/unit", "tests/world", "rosmop/tests", "tests/proofs"), "logical"),
    Stage("nodes", ("tests/integration",), "auto"),
    Stage(
        "machine",
        (
            "tests/system/vm",
            "tests/system/console/test_sign_on.py",
            "tests/system/test_examples.py",
            "tests/system/test_generated_client.py",
            "tests/system/test_recordings_cluster.py",
        ),
    ),
    Stage("containers", ("tests/smoke", "tests/system/containers")),
    Stage("namespaces", ("tests/system",), "auto"),
    Stage("packages", ("tests/package",)),
)


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


def lane_of(file: str) -> str:
    return next((lane for lane, parts in LANES.items() if any(part in file for part in parts)), "core")


def files_of_stages() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {stage.name: [] for stage in STAGES}
    roots = {folder: stage.name for stage in STAGES for folder in stage.folders}
    tests = [ROOT / "tests", ROOT / "rosmop" / "tests"]
    for path in sorted(path for root in tests for path in root.rglob("test_*.py")):
        file = path.relative_to(ROOT).as_posix()
        folder = max((one for one in roots if file == one or file.startswith(f"{one}/")), key=len)
        found[roots[folder]].append(file)
    return found


def outcomes_of(report: Path) -> Iterator[tuple[str, str, float]]:
    for case in xml.etree.ElementTree.parse(report).iter("testcase"):  # noqa: S314  written by pytest
        kinds = {child.tag for child in case}
        outcome = "failed" if kinds & {"failure", "error"} else "skipped" if "skipped" in kinds else "passed"
        yield f"{case.get('file')}::{case.get('name')}", outcome, float(case.get("time", 0))


def unsteady() -> set[str]:
    """Return the ids in the file, in which each line has an id, a date and the reason."""
    lines = UNSTEADY.read_text(encoding="utf-8").splitlines()
    return {line.split()[0] for line in lines if line and not line.startswith("#")}


def run_stage(stage: Stage, files: list[str]) -> tuple[list[tuple[str, str, float]], str]:
    report = FOLDER / f"{stage.name}.xml"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", *files, *stage.options(), "--quiet", "--tb=short"]
    command += [f"--junitxml={report}", "-o", "junit_family=xunit1"]
    environment = os.environ | {"TESTS_EXAMPLES": "all"}
    with (FOLDER / f"{stage.name}.log").open("wb") as log:
        try:
            status = subprocess.run(
                command,
                cwd=ROOT,
                env=environment,
                stdout=log,
                stderr=log,
                timeout=_STAGE_SECONDS,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            return [], f"not finished after {_STAGE_SECONDS / 60:.0f} minutes"
    wrong = "" if status in (0, 1, 5) else f"pytest ended with status {status}"
    return (list(outcomes_of(report)) if report.exists() else []), wrong


def measure(name: str) -> tuple[list[str], str]:
    """Run a program of `MEASUREMENTS`; return its findings, and why there are none."""
    command, output = [sys.executable, "-m", *MEASUREMENTS[name]], _log_of(name)
    with output.open("wb") as log:
        try:
            done = subprocess.run(
                command, cwd=ROOT, stdout=log, stderr=log, timeout=_STAGE_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return [], f"not finished after {_STAGE_SECONDS / 60:.0f} minutes"
    wrong = f"{MEASUREMENTS[name][0]} ended with status {done.returncode}" if done.returncode else ""
    return findings_of(output.read_text(encoding="utf-8")), wrong


def _log_of(name: str) -> Path:
    return FOLDER / f"{name.replace(', ', '-').replace(' ', '-')}.log"


def findings_of(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith("finding: ")]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lane", choices=["core", *LANES], help="run the tests of one lane only")
    lane = parser.parse_args().lane
    open_folders_above(ROOT)
    FOLDER.mkdir(parents=True, exist_ok=True)
    results = _earlier(_commit())
    failed: list[str] = []
    for stage in STAGES:
        files = [file for file in files_of_stages()[stage.name] if lane in (None, lane_of(file))]
        if not files:
            continue
        began, load = _moment(), os.getloadavg()[0]
        outcomes, wrong = run_stage(stage, files)
        failed += [name for name, outcome, _ in outcomes if outcome == "failed"]
        failed += [f"{stage.name}: {wrong} (build/nightly/{stage.name}.log)"] if wrong else []
        _add(results["tests"], outcomes)
        results["runs"].append(
            {
                "stage": stage.name,
                "lane": lane or "all",
                "began": began,
                "ended": _moment(),
                "load": [load, *os.getloadavg()[:1]],
            }
        )
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        count = {
            kind: sum(1 for _, one, _ in outcomes if one == kind) for kind in ("passed", "failed", "skipped")
        }
        print(
            f"{stage.name}: {count['passed']} passed, {count['failed']} failed, {count['skipped']} skipped",
            flush=True,
        )
    for name in MEASUREMENTS if lane in (None, "core") else ():
        found, wrong = measure(name)
        results["findings"] += found
        failed += [f"{name}: {wrong} (build/nightly/{_log_of(name).name})"] if wrong else []
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        print("\n".join([*found, f"{name}: {len(found)} findings (build/nightly/{_log_of(name).name})"]))
    return _report(failed)


def _report(failed: list[str]) -> int:
    known = unsteady()
    for name in failed:
        print(f"FAILED {name}" + (" (known to fail by chance)" if name in known else ""))
    print(f"results: {RESULTS.relative_to(ROOT)}")
    return int(any(name not in known for name in failed))


def _add(tests: dict[str, Any], outcomes: list[tuple[str, str, float]]) -> None:
    for name, outcome, seconds in outcomes:
        row = tests.setdefault(name, {"passed": 0, "failed": 0, "skipped": 0, "seconds": []})
        row[outcome] += 1
        row["seconds"].append(round(seconds, 3))


def _earlier(commit: str) -> dict[str, Any]:
    if RESULTS.exists():
        results: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))
        if results["commit"] == commit:
            return {"findings": []} | results
    return {"commit": commit, "runs": [], "tests": {}, "findings": []}


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def _moment() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


if __name__ == "__main__":
    sys.exit(main())
