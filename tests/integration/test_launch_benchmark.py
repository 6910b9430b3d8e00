import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nodes import ROOT, need_ros
from tests.support.requirements import need_root
from tests.support.waiting import eventually

NODES = 4


@pytest.fixture
def folder() -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="rosrv-test-launch-"))
    made.chmod(0o755)
    yield made
    shutil.rmtree(made)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_launch_leaves_no_process_and_no_file(ending: signal.Signals, folder: Path) -> None:
    need_root()
    need_ros()
    command = [sys.executable, "-m", "benchmarks.launch", "--nodes", str(NODES), "--rounds", "50"]
    launch = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {"TMPDIR": str(folder)}, stderr=subprocess.PIPE
    )
    try:
        eventually(lambda: len(processes_of(f"{folder}/", "/launched/node")) >= NODES, "the nodes do not run")
        launch.send_signal(ending)
        launch.communicate(timeout=60)
    finally:
        launch.kill()
        launch.wait()
    eventually(lambda: not processes_of(f"{folder}/"), lambda: f"left: {processes_of(f'{folder}/')}")
    if ending is not signal.SIGKILL:
        assert not list(folder.iterdir())


def processes_of(*parts: str) -> list[str]:
    lines = []
    for entry in Path("/proc").iterdir():
        try:
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if all(part in line for part in parts):
            lines.append(line)
    return lines
