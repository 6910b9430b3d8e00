import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.command import ROSRV

WORDS = "words() {\n    event said() /chatter std_msgs/String '{}' { }\n}\n"


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with tempfile.TemporaryDirectory(prefix="rosrv-monitors-") as name:
        folder = Path(name)
        folder.chmod(0o755)  # the appliance's users may read it
        (folder / "words.rv").write_text(WORDS)
        with Appliance(options=("--monitors", name, "--api", "127.0.0.1:0")) as appliance:
            appliance.rosrv("token", "add", "olga", "--role", "viewer")
            yield appliance


def completed(words: str, state: str, shell: str = "bash") -> list[str]:
    place = len(words.split(" ")) - 1
    environment = {
        **os.environ, "_ROSRV_COMPLETE": f"complete_{shell}", "ROSRV_STATE": state,
        "COMP_WORDS": words, "COMP_CWORD": str(place),
        "_TYPER_COMPLETE_ARGS": words, "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }  # fmt: skip
    done = subprocess.run([ROSRV], env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert not done.stderr
    return done.stdout.split()


def test_names_of_the_running_appliance(appliance: Appliance) -> None:
    state = str(appliance.state)
    assert completed("rosrv monitor disable wo", state) == ["words"]
    assert completed("rosrv monitor disable x", state) == []
    assert "olga" in completed("rosrv token revoke ", state)
    assert completed("rosrv up --isolation n", state) == ["netns", "none"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_names_in_other_shells(appliance: Appliance, shell: str) -> None:
    offered = " ".join(completed("rosrv monitor disable wo", str(appliance.state), shell))
    assert re.findall(r"\bwords\b", offered) == ["words"]


def test_nothing_where_no_appliance_runs(tmp_path_factory: pytest.TempPathFactory) -> None:
    assert completed("rosrv monitor disable ", str(tmp_path_factory.mktemp("nobody"))) == []
