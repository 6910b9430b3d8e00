import json
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer

from examples.landshark.drive import Simulation, record
from examples.landshark.messages import MONITORS
from tests.support.command import rosrv


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> str:
    bag = tmp_path_factory.mktemp("drive") / "drive.bag"
    record(Simulation().run(), bag)
    return str(bag)


def test_a_learned_specification_accepts_its_recording(drive: str, tmp_path: Path) -> None:
    out = str(tmp_path / "learnt.rv")
    assert rosrv("monitor", "learn", "--bag", drive, "--output", out).returncode == 0
    checked = rosrv("monitor", "check", out)
    assert checked.returncode == 0
    assert "specifications OK\n" in checked.stdout
    assert "warning" not in checked.stdout + checked.stderr
    ran = rosrv("monitor", "run", out, "--bag", drive).stdout
    assert " 0 changed, 0 dropped" in ran
    assert "0 faults" in ran
    again = rosrv("monitor", "learn", "--bag", drive, "--output", out)
    assert again.returncode == 2, "existing files are not overwritten"


def test_json_lists_the_evidence(drive: str) -> None:
    learnt = rosrv("monitor", "learn", "--bag", drive, "--topic", "*/odom", "--json").stdout
    rows = [json.loads(line) for line in learnt.splitlines()]
    assert {row["topic"] for row in rows} == {"/landshark/odom"}
    assert {"range", "rate", "late", "often", "constant"} <= {row["kind"] for row in rows}
    assert all(row["support"]["messages"] > 500 and row["support"]["recordings"] == 1 for row in rows)


def test_coverage_lists_what_never_happened(drive: str) -> None:
    file = str(MONITORS / "logging.rv")
    result = rosrv("monitor", "coverage", file, "--bag", drive, "--fail-under", "80")
    assert result.returncode == 0
    assert f"{file}:12: never: branch if of logging" in result.stdout
    assert "logging" in result.stdout.splitlines()[1]
    assert "4/4" in result.stdout.splitlines()[1]
    assert rosrv("monitor", "coverage", file, "--bag", drive, "--fail-under", "100").returncode == 1
    found = rosrv("monitor", "coverage", file, "--bag", drive, "--json").stdout
    rows = [json.loads(line) for line in found.splitlines()]
    assert {(row["kind"], row["what"]): row["count"] > 0 for row in rows}["event", "shot"]


@pytest.mark.nightly
def test_a_recording_with_another_definition_than_most_is_left_out(tmp_path: Path) -> None:
    for name, text in (("a", "int32 other"), ("b", "int32 data"), ("c", "int32 data # degrees")):
        with Writer(tmp_path / f"{name}.bag") as writer:
            connection = writer.add_connection("/t", "robot_msgs/msg/Count", msgdef=text, md5sum="*")
            for place in range(400):
                writer.write(connection, place * 10**8, bytes(4))
    for given, left_out in (("a b c", "a"), ("b a", "a"), ("a b", "b")):
        bags = (word for name in given.split() for word in ("--bag", str(tmp_path / f"{name}.bag")))
        result = rosrv("monitor", "learn", *bags)
        assert result.returncode == 3
        assert f"{left_out}.bag failed: its definition of robot_msgs/Count differs" in result.stderr
        assert result.stderr.count("failed") == 1
