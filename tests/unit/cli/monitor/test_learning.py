"""`rosrv monitor learn`: what is written, what a script reads, what is refused."""

import json
from pathlib import Path

from rosbags.rosbag1 import Writer

from examples.landshark.drive import Simulation, record
from examples.landshark.messages import MONITORS
from tests.unit.cli.monitor.test_verbs import invoke, make_bag, number


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
    empty = make_bag(tmp_path / "empty.bag", [])
    for arguments, said in (
        (["--bag", empty], "empty.bag has no messages"),
        (["--bag", bad], "bad.bag"),
        (["--bag", tmp_path / "none.bag"], "none.bag"),
        (["--bag", bad, "--bag", bad], "given twice"),
    ):
        result = invoke("learn", *arguments)
        assert result.exit_code == 2
        assert said in result.output


def test_coverage_says_what_never_happened(tmp_path: Path) -> None:
    """A table, the lines of what never happened, an object each for scripts, an exit status for pipelines."""
    bag = tmp_path / "drive.bag"
    record(Simulation().run(), bag)
    text = MONITORS / "logging.rv"
    result = invoke("coverage", text, "--bag", bag, "--fail-under", "80")
    assert result.exit_code == 0
    assert f"{text}:12: never: branch if of logging" in result.output
    assert "logging" in result.output.splitlines()[1] and "4/4" in result.output.splitlines()[1]
    assert invoke("coverage", text, "--bag", bag, "--fail-under", "100").exit_code == 1
    rows = [json.loads(line) for line in invoke("coverage", text, "--bag", bag, "--json").output.splitlines()]
    assert {(row["kind"], row["what"]): row["count"] > 0 for row in rows}["event", "shot"]


def test_coverage_refuses_a_recording_of_another_type(tmp_path: Path) -> None:
    """Messages that the monitors would not see are no coverage."""
    bag = make_bag(tmp_path / "a.bag", [("/landshark/gps", "std_msgs/Int32", 1.0, number(1))])
    result = invoke("coverage", MONITORS / "logging.rv", "--bag", bag)
    assert result.exit_code == 2
    assert "/landshark/gps carries std_msgs/Int32" in result.output


def test_a_type_that_recordings_define_differently_is_refused(tmp_path: Path) -> None:
    """Read by another definition, messages would teach nonsense."""
    for name, text in (("a", "int32 data"), ("b", "int32 other")):
        with Writer(tmp_path / f"{name}.bag") as writer:
            connection = writer.add_connection("/t", "robot_msgs/msg/Count", msgdef=text, md5sum="*")
            for place in range(3):
                writer.write(connection, place, bytes(4))
    result = invoke("learn", "--bag", tmp_path / "a.bag", "--bag", tmp_path / "b.bag")
    assert result.exit_code == 2
    assert "b.bag has another definition of robot_msgs/Count" in result.output
