"""The tutorial's specifications, and what it says of them, are true."""

import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app
from examples.landshark.drive import TRIGGERED, Simulation, record
from examples.landshark.messages import MONITORS

PAGE = (Path(__file__).parents[3] / "docs" / "monitors-tutorial.md").read_text(encoding="utf-8")
FIRST, SECOND = re.findall(r"```cpp\n(.*?)```", PAGE, re.DOTALL)
RIGHT = FIRST.replace("positions:angles", "position:angles")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the reader works: `my-monitors` with the LandShark's message beside."""
    shutil.copytree(MONITORS / "msg", tmp_path / "my-monitors" / "msg")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "my-monitors"


def said(*arguments: str) -> list[str]:
    """What `rosrv monitor` prints."""
    return CliRunner().invoke(app, ["monitor", *arguments]).output.splitlines()


def shown(command: str) -> list[str]:
    """What the page shows below a command, for each time that it does."""
    return [
        line.strip()
        for block in re.findall(rf"    \$ {re.escape(command)}\n((?:    [^$\n].*\n)*)", PAGE)
        for line in block.splitlines()
    ]


def test_check_says_what_the_page_shows(folder: Path) -> None:
    """First the errors, then that it is right."""
    (folder / "gun.rv").write_text(FIRST)
    wrong = said("check", "my-monitors/gun.rv")
    (folder / "gun.rv").write_text(RIGHT)
    assert wrong + said("check", "my-monitors/gun.rv") == shown("rosrv monitor check my-monitors/gun.rv")


def test_run_says_what_the_page_shows(folder: Path) -> None:
    """Of the simulated mission, to the millisecond."""
    (folder / "gun.rv").write_text(RIGHT)
    record(Simulation().run(), Path("mission.bag"))
    found = said("run", "my-monitors/gun.rv", "--bag", "mission.bag")
    assert found == shown("rosrv monitor run my-monitors/gun.rv --bag mission.bag")


def test_the_second_one_locks_after_two_in_a_row(folder: Path) -> None:
    """A single shot at the robot does not lock; the joint states always pass."""
    (folder / "gun.rv").write_text(SECOND)
    guarded = Simulation([folder / "gun.rv"]).run()
    assert [one.result for one in guarded.messages if one.topic == TRIGGERED] == [
        "passed",
        "dropped",
        "passed",
    ]
    assert {one.result for one in guarded.messages if one.topic != TRIGGERED} == {"passed"}
