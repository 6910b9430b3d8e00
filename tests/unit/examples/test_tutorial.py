import math
import re
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app
from examples.landshark.drive import STEP, TRIGGERED, Simulation, record
from examples.landshark.messages import MONITORS

PAGE = (Path(__file__).parents[3] / "docs" / "monitors-tutorial.md").read_text(encoding="utf-8")
FIRST, SECOND, *_OTHERS, LAST = re.findall(r"```cpp\n(.*?)```", PAGE, re.DOTALL)
RIGHT = FIRST.replace("positions:angles", "position:angles")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(MONITORS / "msg", tmp_path / "my-monitors" / "msg")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "my-monitors"


def said(*arguments: str) -> list[str]:
    return CliRunner().invoke(app, ["monitor", *arguments]).output.splitlines()


def shown(command: str) -> list[str]:
    return [
        line.strip()
        for block in re.findall(rf"    \$ {re.escape(command)}\n((?:    [^$\n].*\n)*)", PAGE)
        for line in block.splitlines()
    ]


def test_the_page_quotes_check(folder: Path) -> None:
    (folder / "gun.rv").write_text(FIRST)
    wrong = said("check", "my-monitors/gun.rv")
    (folder / "gun.rv").write_text(RIGHT)
    assert wrong + said("check", "my-monitors/gun.rv") == shown("rosrv monitor check my-monitors/gun.rv")


def test_the_page_quotes_run(folder: Path) -> None:
    (folder / "gun.rv").write_text(RIGHT)
    record(Simulation().run(), Path("mission.bag"))
    found = said("run", "my-monitors/gun.rv", "--bag", "mission.bag")
    assert found == shown("rosrv monitor run my-monitors/gun.rv --bag mission.bag")


def test_the_second_one_locks_after_two_in_a_row(folder: Path) -> None:
    (folder / "gun.rv").write_text(SECOND)
    guarded = Simulation([folder / "gun.rv"]).run()
    assert [message.result for message in guarded.messages if message.topic == TRIGGERED] == [
        "passed",
        "dropped",
        "passed",
    ]
    assert {message.result for message in guarded.messages if message.topic != TRIGGERED} == {"passed"}


def test_the_last_one_keeps_the_robot_slow_while_its_gun_is_raised(folder: Path) -> None:
    (folder / "calm.rv").write_text(LAST)
    assert said("check", "my-monitors/calm.rv") == ["1 specification OK"]
    drive = Simulation([folder / "calm.rv"]).run()
    steps = [math.dist((pose.x, pose.y), (next_.x, next_.y)) for pose, next_ in pairwise(drive.poses)]
    assert 0 < max(steps) <= 0.5 * STEP / 10**9 + 1e-9
