import shutil
from pathlib import Path

import pytest
from rosrv_fleet.cli import app
from typer.testing import CliRunner, Result

from tests.support.enrolled_robots import enrolled_robots
from tests.unit.fleet.test_segment_store import Robot


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    enrolled_robots(tmp_path, "arm7")
    (tmp_path / "fleet.yaml").write_text(f"data: {tmp_path}\n")
    return Robot(tmp_path)


def _verify(folder: Path) -> Result:
    return CliRunner().invoke(app, ["verify", "arm7", "--config", str(folder / "fleet.yaml")])


def test_a_robot_without_segments_lost_nothing(robot: Robot, tmp_path: Path) -> None:
    done = _verify(tmp_path)
    assert (done.exit_code, "nothing was collected yet" in done.output) == (0, True)


@pytest.mark.parametrize("whole", [True, False], ids=["the whole log", "its end"])
def test_a_lost_newest_segment_is_found(whole: bool, robot: Robot, tmp_path: Path) -> None:
    places = [robot.push(number) for number in (1, 2)]
    assert "is missing" not in _verify(tmp_path).output
    if whole:
        shutil.rmtree(tmp_path / "segments" / "arm7")
    else:
        robot.store.path(places[1]).unlink()
    done = _verify(tmp_path)
    assert done.exit_code == 1
    assert "segment 2, the newest that arrived, is missing" in done.output
