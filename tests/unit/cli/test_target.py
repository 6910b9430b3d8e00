"""Tests of `appliance.cli.target`: what a user is told who may not, or cannot, speak to the appliance."""

import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.requirements import need_root

ROSRV = str(Path(sys.executable).parent / "rosrv")
NOBODY = ("/usr/bin/setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
VERBS = [("status",), ("policy", "reload"), ("token", "list"), ("audit", "search"), ("audit", "verify")]


@pytest.fixture
def state() -> Iterator[Path]:
    """A state directory as root's appliance leaves it: others may pass through, not look."""
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX) as listener:
        Path(name).chmod(0o711)
        listener.bind(f"{name}/admin.sock")
        listener.listen()
        (Path(name) / "admin.sock").chmod(0o600)
        (Path(name) / "control").mkdir(mode=0o710)
        yield Path(name)


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_who_is_not_root_is_told_so(state: Path, verb: tuple[str, ...]) -> None:
    """One sentence names the file and says as whom to run it; exit status 2."""
    need_root()
    command = [*NOBODY, ROSRV, *verb, "--state", str(state)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"rosrv: {state}/")
    assert "root" in line


@pytest.mark.parametrize("verb", VERBS[:3], ids=" ".join)
def test_where_nothing_runs_it_is_told_how_to_start(tmp_path: Path, verb: tuple[str, ...]) -> None:
    """A directory without a running appliance, and none at all, are told apart; exit status 2."""
    for place, advice in ((tmp_path, "rosrv up"), (tmp_path / "nowhere", "--state")):
        command = [ROSRV, *verb, "--state", str(place)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"rosrv: {place}: ")
        assert advice in line
