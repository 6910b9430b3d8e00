import itertools
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.cold import LONE
from benchmarks.launch import RESULTS, findings, table_ratios
from tests.nightly import (
    LANES,
    LINES,
    MEASUREMENTS,
    STAGES,
    STEPS,
    UNSTEADY,
    files_of_stages,
    findings_of,
    is_before,
    lane_of,
    minutes_of,
    outcomes_of,
    row_of,
    rows_of,
    run_limited,
    steps_of,
    unsteady,
)
from tests.steady import largest_chance
from tests.support.determinism import WATCH, ChanceError
from tests.support.sources import ROOT
from tests.support.waiting import eventually

REPORT = """<testsuites><testsuite>
<testcase file="tests/a.py" name="test_one[x]" time="1.5"/>
<testcase file="tests/a.py" name="test_two" time="0.1"><failure message="no"/></testcase>
<testcase file="tests/a.py" name="test_three" time="0.0"><skipped message="later"/></testcase>
</testsuite></testsuites>"""


@pytest.mark.parametrize(
    "act",
    [
        lambda: threading.Thread(target=print).start(),
        lambda: subprocess.run(["true"], check=True),
        lambda: socket.socket().close(),
        lambda: time.sleep(0),  # noqa: TID251  it is forbidden
    ],
    ids=["thread", "process", "socket", "pause"],
)
def test_a_deterministic_test_may_not_depend_on_chance(act: Callable[[], object]) -> None:
    with WATCH.watching() as found, pytest.raises(ChanceError):
        act()
    assert len(found) == 1
    assert "test_gate" in found[0]


def test_every_test_file_runs_at_night_in_one_stage() -> None:
    stages = files_of_stages()
    files = [file for named in stages.values() for file in named]
    assert len(files) == len(set(files)) > 500
    assert all(stages[stage.name] for stage in STAGES)
    assert {lane_of(file) for file in files} == {"core", *LANES}


def test_the_worlds_of_a_file_are_spread_over_the_workers() -> None:
    """On one worker, those of tests/world/closed_loop would take longer than a stage may."""
    [worlds] = (stage for stage in STAGES if "tests/world" in stage.folders)
    assert worlds.options() == ["-n", "logical", "--dist", "load"]


def test_a_lane_has_the_stages_of_its_tests() -> None:
    assert steps_of("all") == [*STEPS]
    assert steps_of("console") == ["machine", "namespaces"]
    assert MEASUREMENTS.keys().isdisjoint(steps_of("standby"))
    assert MEASUREMENTS.keys() <= {*steps_of("core")}


# A worker has no network, as tests/conftest.py says.
FETCHES = re.compile(r'npm, "ci"|"pip", "(sync|install)"|doors\.test_roslib import')


def test_files_that_fetch_packages_run_where_there_is_a_network() -> None:
    stages = files_of_stages()
    fetching = {
        file: stage.name
        for stage in STAGES
        for file in stages[stage.name]
        if file != "tests/unit/support/test_gate.py" and FETCHES.search((ROOT / file).read_text())
    }
    assert len(fetching) > 1
    assert [
        file for file, name in fetching.items() if name not in {"machine", "containers", "packages"}
    ] == []
    assert all(not stage.workers for stage in STAGES if stage.name in fetching.values())


def test_a_computing_stage_leaves_the_processors_to_others() -> None:
    """A computing stage beside another one would take a processor from real parts that keep time."""
    for beside in itertools.combinations(LINES, 2):
        assert any(stage.computes for stage in itertools.chain(*beside))
    [line] = (line for line in LINES if any(stage.computes for stage in line))
    assert [stage.computes for stage in line] == sorted(stage.computes for stage in line)


def test_a_night_resumes_in_the_line_of_its_stage() -> None:
    assert [step for step in STEPS if is_before(step, "containers", ())] == ["nodes"]
    assert [step for step in STEPS if is_before(step, "containers", {"machine"})] == ["machine", "nodes"]
    assert [step for step in STEPS if is_before(step, "computing", {"computing"})] == ["machine"]
    assert [step for step in STEPS if is_before(step, "start", ())] == [stage.name for stage in STAGES]


def test_minutes_of_stages_side_by_side_count_once() -> None:
    day = "2026-01-01T"
    runs = [
        {"began": f"{day}01:00:00+00:00", "ended": f"{day}01:30:00+00:00"},
        {"began": f"{day}01:10:00+00:00", "ended": f"{day}01:20:00+00:00"},
        {"began": f"{day}01:20:00+00:00", "ended": f"{day}01:45:00+00:00"},
        {"began": f"{day}09:00:00+00:00", "ended": f"{day}09:05:00+00:00"},
        {"stage": "machine"},
    ]
    assert minutes_of(runs) == 50


@pytest.mark.nightly
def test_a_low_program_yields_the_processors(tmp_path: Path) -> None:
    command = ["sh", "-c", "sleep 0.5; nice; cat /proc/self/autogroup 2>/dev/null || echo nice 10"]
    assert run_limited(command, tmp_path / "log", 60.0, low=True) == 0
    value, group = (tmp_path / "log").read_text().splitlines()
    assert value == "10"
    assert group.endswith("nice 10")


def test_a_resumed_night_has_the_newest_run_of_each_stage_of_its_lane() -> None:
    runs = [
        {"stage": "nodes", "lane": "all", "failed": ["a"]},
        {"stage": "nodes", "lane": "fleet", "failed": ["b"]},
        {"stage": "nodes", "lane": "all", "failed": []},
    ]
    assert rows_of(runs, "all", ["nodes", "machine"]) == [runs[2], {"stage": "machine"}]


def test_the_table_of_a_night_names_what_did_not_run() -> None:
    assert row_of({"stage": "machine"}) == "machine              not run"
    run = {
        "stage": "nodes",
        "minutes": 41.26,
        "passed": 400,
        "failed": ["a"],
        "skipped": 2,
        "free_gigabytes": 60,
    }
    assert row_of(run) == "nodes                 41.3 min    400 passed    1 failed    2 skipped  60 GB free"


@pytest.mark.nightly
def test_a_stage_that_hangs_writes_its_report_and_leaves_no_process(tmp_path: Path) -> None:
    script = "trap 'echo written; exit 2' INT; sleep 600 & echo $!; while true; do sleep 0.1; done"
    assert run_limited(["bash", "-c", script], tmp_path / "log", 2.0) is None
    child, word = (tmp_path / "log").read_text().split()
    assert word == "written"
    eventually(lambda: "State:" not in (status := _status(child)) or "(zombie)" in status, f"{child} runs")


def _status(process: str) -> str:
    try:
        return Path(f"/proc/{process}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


@pytest.mark.nightly
def test_a_program_that_ends_in_time_has_its_status(tmp_path: Path) -> None:
    command = ["sh", "-c", "echo $NIGHT; exit 5"]
    assert run_limited(command, tmp_path / "log", 60.0, {"NIGHT": "all"}) == 5
    assert (tmp_path / "log").read_text() == "all\n"


def test_results_are_read_from_the_report(tmp_path: Path) -> None:
    (tmp_path / "report.xml").write_text(REPORT)
    assert list(outcomes_of(tmp_path / "report.xml")) == [
        ("tests/a.py::test_one[x]", "passed", 1.5),
        ("tests/a.py::test_two", "failed", 0.1),
        ("tests/a.py::test_three", "skipped", 0.0),
    ]


def test_the_table_of_a_start_has_a_ratio_for_each_measured_row() -> None:
    for robot in ("40 roscpp nodes", "100 roscpp nodes", "40 rospy nodes", "40 roscpp nodes, `--busy`"):
        ratios = table_ratios(RESULTS.read_text(), robot)
        assert len(ratios) == 8
        assert all(0.1 < ratio < 10 for ratio in ratios.values())
    assert table_ratios(RESULTS.read_text(), "40 roscpp nodes")["one getParam during the start"] > 0
    assert table_ratios(RESULTS.read_text(), "7 roscpp nodes") == {}


def test_a_start_is_a_finding_only_if_every_round_differs_by_a_fifth() -> None:
    table = {"up": 2.0}
    assert findings({"up": [2.41, 2.5, 3.0]}, table)
    assert findings({"up": [1.0, 1.5, 1.66]}, table)
    assert findings({"up": [2.39, 2.5, 3.0]}, table) == []
    assert findings({"up": [1.0, 1.5, 3.0]}, table) == []


def test_a_row_that_the_table_lacks_is_a_finding() -> None:
    assert findings({"down": [1.0]}, {"up": 2.0})


def test_the_table_of_a_lone_message_has_both_columns() -> None:
    for column in (LONE, f"{LONE}, `--busy`"):
        assert f"| {column}, load" in RESULTS.read_text()
        assert all(0.1 < ratio < 10 for ratio in table_ratios(RESULTS.read_text(), column).values())


def test_the_findings_of_a_start_are_read_from_its_output() -> None:
    [line] = findings({"up": [3.0, 4.0, 5.0]}, {"up": 2.0})
    assert line == "finding: up: 4.00 (3.00 to 5.00) times the plain master's, 2.00 in the table"
    assert findings_of(f"  8 rounds\n{line}\nno finding\n") == [line]


def test_the_bound_of_a_chance() -> None:
    assert largest_chance(0, 300) == pytest.approx(3 / 300, rel=0.01)
    assert largest_chance(5, 50) == pytest.approx(0.2, abs=0.005)
    assert largest_chance(7, 7) == pytest.approx(1.0)


def test_few_tests_are_unsteady_each_with_a_date_and_a_reason() -> None:
    lines = [line for line in UNSTEADY.read_text().splitlines() if line and not line.startswith("#")]
    assert len(unsteady()) == len(lines) <= 10
    assert all(re.fullmatch(r"\S+::\S+ 20\d\d-\d\d-\d\d \S.{20,}", line) for line in lines)
