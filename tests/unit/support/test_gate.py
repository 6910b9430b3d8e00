import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.launch import LONE, RESULTS, findings, table_ratios
from tests import nightly
from tests.gate import digest
from tests.nightly import (
    Lane,
    changed_since,
    every_file,
    files_of,
    findings_of,
    lanes,
    outcomes_of,
    record,
    release,
    row_of,
    row_of_file,
    run_limited,
    run_tests,
    turn,
)  # fmt: skip
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


def test_every_test_file_is_in_one_lane() -> None:
    files = every_file()
    assert len(files) > 500
    assert [file for file in files if not row_of_file(file)] == []
    rows = {lane.row: files_of(lane) for lane in lanes().values() if lane.tests}
    assert sorted(file for named in rows.values() for file in named) == files
    assert all(rows.values())


def test_the_parts_of_a_row_are_all_of_its_tests() -> None:
    worlds = [lane.part for lane in lanes().values() if lane.row == "worlds"]
    assert worlds == [f"{number}/{len(worlds)}" for number in range(1, len(worlds) + 1)]


def test_each_lane_has_its_turn() -> None:
    names = [*lanes()]
    assert [turn(1_700_000_000 + 60 * minute) for minute in range(len(names))].count("nodes") == 1
    assert {turn(1_700_000_000 + 60 * minute + 59) for minute in range(len(names))} == set(names)


# A worker has no network, as tests/conftest.py says.
FETCHES = re.compile(r'npm, "ci"|"pip", "(sync|install)"|doors\.test_roslib import')


def test_files_that_fetch_packages_run_where_there_is_a_network() -> None:
    fetching = {
        file: row_of_file(file)
        for file in every_file()
        if file != "tests/unit/support/test_gate.py" and FETCHES.search((ROOT / file).read_text())
    }
    assert len(fetching) > 1
    assert all(not lane.workers for lane in lanes().values() if lane.row in fetching.values())


def test_the_row_of_a_run() -> None:
    run = {
        "lane": "nodes", "minutes": 41.26, "passed": 400, "failed": ["a"], "skipped": 2, "flaky": [],
        "free_gigabytes": 60,
    }  # fmt: skip
    assert (
        row_of(run)
        == "nodes             41.3 min    400 passed    1 failed    0 flaky    2 skipped  60 GB free"
    )


CHANCE = """
from pathlib import Path
def test_by_chance():
    path = Path(__file__).with_name("ran")
    ran = path.exists()
    path.touch()
    assert ran
def test_never():
    assert False
def test_always():
    pass
"""


@pytest.mark.nightly
def test_a_test_that_fails_runs_once_more_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nightly, "FOLDER", tmp_path)
    (tmp_path / "test_chance.py").write_text(CHANCE)
    outcomes, flaky, wrong = run_tests(Lane("one"), [str(tmp_path / "test_chance.py")], 60.0)
    assert [outcome for _, outcome, _ in outcomes] == ["failed", "failed", "passed"]
    assert [test.partition("::")[2] for test in flaky] == ["test_by_chance"]
    assert wrong == ""


@pytest.mark.nightly
def test_a_lane_that_hangs_is_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nightly, "FOLDER", tmp_path)
    (tmp_path / "test_hang.py").write_text(
        "import threading\ndef test_hang():\n    threading.Event().wait()\n"
    )
    _, flaky, wrong = run_tests(Lane("one"), [str(tmp_path / "test_hang.py")], 6.0)
    assert (flaky, wrong) == ([], "not finished after 0 minutes")


LEAVING = """
import time
from appliance.base import clock
from tests.support.virtual_clock import VirtualClock
kept = clock.using(VirtualClock())
def test_clock():
    kept.__enter__()
def test_time():
    time.monotonic = lambda: 0.0
def test_nothing():
    assert time.monotonic() > 0 and not isinstance(clock.source(), VirtualClock)
"""


@pytest.mark.nightly
def test_a_test_that_leaves_another_clock_fails(tmp_path: Path) -> None:
    (tmp_path / "test_leaving.py").write_text("import pytest\npytestmark = pytest.mark.nightly\n" + LEAVING)
    command = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", "-p", "conftest", "-q"]
    ran = subprocess.run([*command, tmp_path], cwd=ROOT, capture_output=True, text=True, check=False)
    assert "3 passed, 2 errors" in ran.stdout
    assert "this test left replaced: appliance.base.clock\n" in ran.stdout
    assert "this test left replaced: time.monotonic\n" in ran.stdout


def test_a_release_names_each_lane_that_is_not_green(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        nightly, "changed_since", lambda lane, commit: ["appliance/x.py"] if lane.row == "units" else []
    )
    green = {
        name: {"commit": "abc", "ended": "now", "passed": 3, "skipped": 0, "flaky": []}
        for name in lanes()
        if name != "nodes"
    }
    assert release(green, "") == 1
    said = capsys.readouterr().err
    assert "  nodes: it was not green\n" in said
    assert "  units-1: appliance/x.py changed since abc\n" in said
    assert "networks" not in said
    assert release(green, "only a word changed") == 0
    assert "only a word changed\n  nodes: it was not green\n" in capsys.readouterr().out
    assert release(green | {"nodes": green["networks"]}, "") == 1


def test_a_green_lane_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nightly, "GREEN", tmp_path / "green.json")
    nightly.GREEN.write_text('{"nodes": {"commit": "old"}, "fleet": {"commit": "old"}, "gone": {}}')
    record({"green": {"nodes": {"commit": "new"}}})
    assert json.loads(nightly.GREEN.read_text()) == {"nodes": {"commit": "new"}, "fleet": {"commit": "old"}}


@pytest.mark.nightly
def test_a_lane_is_as_old_as_its_files() -> None:
    assert changed_since(lanes()["nodes"], "HEAD") == []
    assert changed_since(lanes()["nodes"], "0" * 40) == ["(this clone lacks the commit: all)"]


@pytest.mark.nightly
def test_a_digest_has_what_is_not_committed(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    found = {digest(["one"], tmp_path)}
    (tmp_path / "one").mkdir()
    (tmp_path / "other").write_text("no file of this product")
    found.add(digest(["one"], tmp_path))
    assert len(found) == 1
    for text in ("new", "edited"):
        (tmp_path / "one" / "file.py").write_text(text)
        found.add(digest(["one"], tmp_path))
    (tmp_path / "one" / "file.py").chmod(0o755)
    found.add(digest(["one"], tmp_path))
    subprocess.run(["git", "add", "one"], cwd=tmp_path, check=True)
    (tmp_path / "one" / "file.py").unlink()
    found.add(digest(["one"], tmp_path))
    assert len(found) == 5


@pytest.mark.nightly
def test_a_program_that_hangs_writes_its_report_and_leaves_no_process(tmp_path: Path) -> None:
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
