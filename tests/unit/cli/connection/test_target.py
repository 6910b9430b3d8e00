import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.requirements import need_root

pytestmark = pytest.mark.nightly

ROSRV = str(Path(sys.executable).parent / "rosrv")
NOBODY = ("/usr/bin/setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
VERBS = [("status",), ("policy", "reload"), ("token", "list"), ("audit", "search"), ("audit", "verify")]


@pytest.fixture
def state() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX) as listener:
        Path(name).chmod(0o711)
        listener.bind(f"{name}/admin.sock")
        listener.listen()
        (Path(name) / "admin.sock").chmod(0o600)
        (Path(name) / "control").mkdir(mode=0o710)
        yield Path(name)


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_a_user_who_is_not_root_gets_advice(state: Path, verb: tuple[str, ...]) -> None:
    need_root()
    command = [*NOBODY, ROSRV, *verb, "--state", str(state)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"rosrv: {state}/")
    assert "root" in line
