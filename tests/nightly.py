"""Run all tests and report each: `make nightly`, or the tests of one lane, `make nightly LANE=standby`.

The stages are in two lines that run side by side, because stages with real parts wait most of their time. It never
stops at a failure, and ends with a table of the stages and the list of the failures. `--from STAGE`
(`make nightly FROM=nodes`) resumes: the results of the same commit stand for the stages before it.
`build/nightly/results.json` has passes, failures and seconds of each test, and the commit, start, end and load average
of each run. Runs of the same commit add up. Network namespaces that are left after all stages, and a robot's start
(`benchmarks/launch.py`) or a delay of a lone message (`benchmarks/cold.py`) that differs by more than 20 % from the
table in `benchmarks/RESULTS.md`, are printed as findings. The exit status is 1 if a test failed that
`tests/unsteady.txt` does not list, or if one of these programs failed.
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
import threading
import time
import xml.etree.ElementTree
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
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
_RESULTS_LOCK = threading.Lock()
UNSTEADY = ROOT / "tests" / "unsteady.txt"
_STAGE_SECONDS = 90 * 60.0  # a stage that hangs ends, and counts as failed
_END_SECONDS = 60.0  # for an interrupted stage to write its report

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
    """Tests that run side by side on `workers` of pytest-xdist, or one after the other.

    The tests of a file share a worker, and what the file makes for all of them, unless `spread`. A stage that
    `computes` leaves the processors to the other line.
    """

    name: str
    folders: tuple[str, ...]
    workers: str = ""
    spread: bool = False
    computes: bool = False

    def options(self) -> list[str]:
        distribution = ("load",) if self.spread else ("loadfile", "--no-loadscope-reorder")
        return ["-n", self.workers, "--dist", *distribution] if self.workers else []


# A worker has no network but a loopback of its own, so tests that fetch packages run without workers, as do those that
# start many processes themselves.
LINES = (
    (
        Stage(
            "machine",
            (
                "tests/integration/examples/test_ros2.py",
                "tests/system/features/doors",
                "tests/system/network/test_adopt_nodes.py",
                "tests/system/vm",
                "tests/system/console/test_sign_on.py",
                "tests/system/test_examples.py",
                "tests/system/test_generated_client.py",
                "tests/system/test_recordings_cluster.py",
            ),
        ),
        Stage("computing", ("tests/unit", "rosmop/tests", "tests/proofs"), "logical", computes=True),
        Stage(  # files that each compute for a quarter of an hour or more
            "worlds",
            (
                "rosmop/tests/prove/test_equality.py",
                "tests/world",
                "tests/integration/test_entrance_mutants.py",
                "tests/unit/features/test_without_a_feature.py",
            ),
            "logical",
            spread=True,
            computes=True,
        ),
    ),
    (
        Stage("nodes", ("tests/integration",), "auto"),
        Stage("containers", ("tests/smoke", "tests/system/containers")),
        Stage("namespaces", ("tests/system",), "auto"),
        Stage("packages", ("tests/package",)),
    ),
)
STAGES = tuple(stage for line in LINES for stage in line)


STEPS = (*(stage.name for stage in STAGES), *MEASUREMENTS)


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
    command += ["--timeout=1200"] if stage.computes else []  # a test has a part of a processor only
    environment = {"TESTS_EXAMPLES": "all", "TESTS_PATIENCE": "2"}  # while the other line computes
    log = FOLDER / f"{stage.name}.log"
    # The other line may have the processors for an hour.
    seconds = _STAGE_SECONDS * (2 if stage.computes else 1)
    status = run_limited(command, log, seconds, environment, low=stage.computes)
    wrong = "" if status in (0, 1, 5) else f"pytest ended with status {status}"
    wrong = _late(seconds) if status is None else wrong
    return (list(outcomes_of(report)) if report.exists() else []), wrong


def _late(seconds: float) -> str:
    return f"not finished after {seconds / 60:.0f} minutes"


_RUNNING: set[int] = set()  # leaders of process groups


def run_limited(
    command: Sequence[str],
    output: Path,
    seconds: float,
    environment: Mapping[str, str] | None = None,
    *,
    low: bool = False,
) -> int | None:
    """Run a program and return its status, or None if it was interrupted after `seconds`.

    A `low` one has what other programs leave of the processors.

    An interrupted pytest reports the tests that have ended. A minute later all processes of the program are killed, so
    that none disturbs the next stage.
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
        _RUNNING.add(program.pid)
        if low:
            os.setpriority(os.PRIO_PROCESS, program.pid, 10)
            # Where the kernel groups processes by session, only the group's own value counts against other sessions.
            with contextlib.suppress(FileNotFoundError):
                Path(f"/proc/{program.pid}/autogroup").write_text("10")
        try:
            return program.wait(seconds)
        except subprocess.TimeoutExpired:
            program.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                program.wait(_END_SECONDS)
            return None
        finally:
            _RUNNING.discard(program.pid)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(program.pid, signal.SIGKILL)


def measure(name: str) -> tuple[list[str], str]:
    """Run a program of `MEASUREMENTS`. Return its findings, or the reason why it has none."""
    status = run_limited([sys.executable, "-m", *MEASUREMENTS[name]], _log_of(name), _STAGE_SECONDS)
    if status is None:
        return [], _late(_STAGE_SECONDS)
    wrong = f"{MEASUREMENTS[name][0]} ended with status {status}" if status else ""
    return findings_of(_log_of(name).read_text(encoding="utf-8")), wrong


def _log_of(name: str) -> Path:
    return FOLDER / f"{name.replace(', ', '-').replace(' ', '-')}.log"


def findings_of(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith("finding: ")]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--lane", choices=["core", *LANES], default="all", help="run the tests of one lane only"
    )
    parser.add_argument(
        "--from", choices=STEPS, default=STEPS[0], dest="first", help="resume with this stage"
    )
    arguments = parser.parse_args()
    lane, first = arguments.lane, arguments.first
    open_folders_above(ROOT)
    for end in (signal.SIGINT, signal.SIGTERM):  # a script's background process ignores SIGINT
        signal.signal(end, _end)
    FOLDER.mkdir(parents=True, exist_ok=True)
    results, steps = _earlier(_commit()), steps_of(lane)
    resumes = first != STEPS[0]
    ended = {run["stage"] for run in results["runs"] if run["lane"] == lane and resumes}
    waiting = [step for step in steps if not is_before(step, first, ended)]
    namespaces = _namespaces()
    with ThreadPoolExecutor(len(LINES)) as lines:
        runs = [lines.submit(run_line, line, waiting, lane, results) for line in LINES]
    for run in runs:
        run.result()
    left = sorted(_namespaces() - namespaces)
    results["findings"] += [f"finding: new network namespaces: {', '.join(left)}"] if left else []
    for step in waiting:
        if step in MEASUREMENTS:
            run_step(step, lane, results)
    return _report(rows_of(results["runs"], lane, steps), results["findings"])


def _end(number: int, _frame: object) -> None:
    """End the programs of both lines, then this one: a line that waits for its program would not end."""
    for leader in _RUNNING.copy():
        with contextlib.suppress(ProcessLookupError):
            os.killpg(leader, signal.SIGKILL)
    os._exit(128 + number)


def is_before(step: str, first: str, ended: Collection[str]) -> bool:
    """Return whether a run that resumes with `first` leaves out a step: an earlier one of its line, or one of the other
    line that has `ended`. A measurement comes after both lines.
    """
    if first in MEASUREMENTS:
        return STEPS.index(step) < STEPS.index(first)
    [line] = ([stage.name for stage in line] for line in LINES if first in {stage.name for stage in line})
    return step in line[: line.index(first)] or (step in ended and step not in line)


def run_line(line: Sequence[Stage], waiting: Sequence[str], lane: str, results: dict[str, Any]) -> None:
    for stage in line:
        if stage.name in waiting:
            run_step(stage.name, lane, results)


def files_of(stage: str, lane: str) -> list[str]:
    return [file for file in files_of_stages()[stage] if lane in ("all", lane_of(file))]


def steps_of(lane: str) -> list[str]:
    """Return the stages with tests of a lane, and the measurements of the core's."""
    measured = MEASUREMENTS if lane in ("all", "core") else ()
    return [*(stage.name for stage in STAGES if files_of(stage.name, lane)), *measured]


def run_step(name: str, lane: str, results: dict[str, Any]) -> None:
    began, clock, load = _moment(), time.monotonic(), os.getloadavg()[0]
    findings: list[str] = []
    outcomes: list[tuple[str, str, float]] = []
    if name in MEASUREMENTS:
        findings, wrong = measure(name)
    else:
        [stage] = (stage for stage in STAGES if stage.name == name)
        outcomes, wrong = run_stage(stage, files_of(name, lane))
    failed = [test for test, outcome, _seconds in outcomes if outcome == "failed"]
    run = {
        "stage": name,
        "lane": lane,
        "began": began,
        "ended": _moment(),
        "minutes": round((time.monotonic() - clock) / 60, 1),
        "load": [load, *os.getloadavg()[:1]],
        "free_gigabytes": shutil.disk_usage(ROOT).free >> 30,
        "passed": sum(1 for _, outcome, _ in outcomes if outcome == "passed"),
        "skipped": sum(1 for _, outcome, _ in outcomes if outcome == "skipped"),
        "failed": failed + ([f"{name}: {wrong} ({_log_of(name).relative_to(ROOT)})"] if wrong else []),
    }
    with _RESULTS_LOCK:
        _add(results["tests"], outcomes)
        results["findings"] += findings
        results["runs"].append(run)
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print("\n".join([*findings, row_of(run)]), flush=True)


def _namespaces() -> set[str]:
    folder = Path("/run/netns")
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def rows_of(runs: Sequence[dict[str, Any]], lane: str, steps: Sequence[str]) -> list[dict[str, Any]]:
    """Return the newest run of each step of a lane, or only its name."""
    newest = {run["stage"]: run for run in runs if run["lane"] == lane}
    return [newest.get(step, {"stage": step}) for step in steps]


def row_of(run: dict[str, Any]) -> str:
    if "minutes" not in run:
        return f"{run['stage']:<20} not run"
    counts = f"{run['passed']:>6} passed {len(run['failed']):>4} failed {run['skipped']:>4} skipped"
    return f"{run['stage']:<20}{run['minutes']:>6.1f} min {counts}  {run['free_gigabytes']} GB free"


def _report(runs: Sequence[dict[str, Any]], findings: Sequence[str]) -> int:
    known = unsteady()
    failed = [name for run in runs for name in run.get("failed", ())]
    total = minutes_of(runs)
    print("\n".join(["", *map(row_of, runs), f"{'all':<20}{total:>6.1f} min", *findings]))
    for name in failed:
        print(f"FAILED {name}" + (" (known to fail by chance)" if name in known else ""))
    print(f"results: {RESULTS.relative_to(ROOT)}")
    return int(any(name not in known for name in failed))


def minutes_of(runs: Sequence[dict[str, Any]]) -> float:
    """Return the minutes in which at least one of the runs went on."""
    moments = ((run["began"], run["ended"]) for run in runs if "began" in run)
    spans = sorted(tuple(datetime.datetime.fromisoformat(text) for text in pair) for pair in moments)
    total, last = datetime.timedelta(), datetime.datetime.min.replace(tzinfo=datetime.UTC)
    for began, ended in spans:
        total += max(ended - max(began, last), datetime.timedelta())
        last = max(last, ended)
    return total.total_seconds() / 60


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
