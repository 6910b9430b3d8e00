"""docs/first-hour.md, followed command by command on three machines: the page shows the real output."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.command import ROSRV
from tests.support.own_namespace import own_namespace
from tests.support.page_steps import steps
from tests.support.processes import LIMIT, Process
from tests.support.requirements import need_root


@pytest.fixture
def hosts() -> Iterator[dict[str, Host]]:
    need_root()
    with own_namespace(), Lab("rosrv-hour") as lab:
        yield {
            "machine": lab.host("machine", "10.84.0.2/24"),
            "robot": lab.host("robot", "10.84.0.10/24"),
            "visitor": lab.host("visitor", "10.84.0.66/24"),
        }


@pytest.fixture
def folder() -> Iterator[Path]:
    folder = Path(f"/tmp/rosrv-hour-{os.getpid()}")
    folder.mkdir(mode=0o755)
    yield folder
    shutil.rmtree(folder)


def test_the_page_is_true(hosts: dict[str, Host], folder: Path) -> None:
    staying: list[Process] = []
    environment = {
        "PATH": f"{Path(ROSRV).parent}:{os.environ['PATH']}",
        "HOME": str(folder),
        "PYTHONUNBUFFERED": "1",
        "COLUMNS": "200",
    }
    try:
        for step in steps("first-hour.md"):
            script = f"exec 2>&1\ncd {folder}\n" + step.script.replace("/var/lib/rosrv", f"{folder}/state")
            command = ["bash", "-euo", "pipefail", "-c", script]
            label = f"{step.host}: {step.script.splitlines()[-1]}"
            process = Process(hosts[step.host], command, env=environment, label=label)
            shown = [line.replace("/var/lib/rosrv", f"{folder}/state") for line in step.shown]
            if step.how == "stays":
                staying.append(process)
            else:
                code = process.wait(timeout=90)
                assert (code != 0) == (step.how == "fails"), process.story()
                process.stop()
            for line in shown:
                process.wait_for_text(line, timeout=2 * LIMIT)
    finally:
        for process in reversed(staying):
            os.killpg(process.pid, signal.SIGTERM)
            process.stop(timeout=20)
