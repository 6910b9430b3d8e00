"""`rosrv monitor learn`: what is written, what a script reads, what is refused."""

import json
from pathlib import Path

from examples.landshark.drive import Simulation, record
from tests.unit.cli.monitor.test_verbs import invoke


def test_what_is_learnt_is_right_and_finds_nothing_in_its_own_recording(tmp_path: Path) -> None:
    """The file passes `check` without a warning, with the robot's own definitions beside it, and drops nothing."""
    bag, out = tmp_path / "drive.bag", tmp_path / "learnt.rv"
    record(Simulation().run(), bag)
    assert invoke("learn", "--bag", bag, "--out", out).exit_code == 0
    checked = invoke("check", out)
    assert checked.exit_code == 0
    assert "specifications right\n" in checked.output and "warning" not in checked.output
    ran = invoke("run", out, "--bag", bag)
    assert " 0 changed, 0 dropped" in ran.output and "0 faults" in ran.output
    assert invoke("learn", "--bag", bag, "--out", out).exit_code == 2  # nothing is written over


def test_a_script_reads_what_it_stands_on(tmp_path: Path) -> None:
    """One object for each condition, of the chosen topics only."""
    bag = tmp_path / "drive.bag"
    record(Simulation().run(), bag)
    rows = [
        json.loads(line)
        for line in invoke("learn", "--bag", bag, "--topic", "*/odom", "--json").output.splitlines()
    ]
    assert {row["topic"] for row in rows} == {"/landshark/odom"}
    assert {"range", "rate", "late", "often", "constant"} <= {row["kind"] for row in rows}
    assert all(row["support"]["messages"] > 500 and row["support"]["recordings"] == 1 for row in rows)


def test_a_bad_bag_is_refused_with_its_name(tmp_path: Path) -> None:
    """A file that is no bag, one that is not there, and one given twice."""
    bad = tmp_path / "bad.bag"
    bad.write_bytes(b"no bag at all")
    for arguments, said in (
        (["--bag", bad], "bad.bag"),
        (["--bag", tmp_path / "none.bag"], "none.bag"),
        (["--bag", bad, "--bag", bad], "given twice"),
    ):
        result = invoke("learn", *arguments)
        assert result.exit_code == 2
        assert said in result.output
