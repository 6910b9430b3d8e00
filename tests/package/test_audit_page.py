import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.own_namespace import own_namespace
from tests.support.page_steps import steps
from tests.support.processes import LIMIT, Process
from tests.support.requirements import need_root

pytestmark = pytest.mark.timeout(1200)  # the package is built first


@pytest.fixture
def hosts() -> Iterator[dict[str, Host]]:
    need_root()
    with own_namespace(), Lab("rosrv-audit") as lab:
        yield {
            "machine": lab.host("machine", "10.84.0.2/24"),
            "robot": lab.host("robot", "10.84.0.10/24"),
            "visitor": lab.host("visitor", "10.84.0.66/24"),
        }


@pytest.fixture
def installed(package: Path, tmp_path: Path) -> Iterator[Path]:
    need_root()
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", tmp_path], check=True)
    root = tmp_path / "root"
    for folder in (root, tmp_path / "changes", tmp_path / "work"):
        folder.mkdir()
    layers = f"lowerdir=/,upperdir={tmp_path}/changes,workdir={tmp_path}/work"
    try:
        subprocess.run(["mount", "-t", "overlay", "overlay", "-o", layers, root], check=True)
        for shared in ("dev", "proc", "run", "sys"):
            subprocess.run(["mount", "--rbind", f"/{shared}", root / shared], check=True)
            subprocess.run(["mount", "--make-rslave", root / shared], check=True)
        (root / "root").chmod(0o700)  # as Debian makes it
        (root / "rosrv.deb").write_bytes(package.read_bytes())
        done = subprocess.run(
            ["chroot", root, "dpkg", "--install", "/rosrv.deb"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        yield root
    finally:
        subprocess.run(["umount", "--recursive", "--lazy", tmp_path], check=True)


def test_the_page_is_true(hosts: dict[str, Host], installed: Path) -> None:
    staying: list[Process] = []
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/root",
        "PYTHONUNBUFFERED": "1",
        "COLUMNS": "200",
    }
    try:
        for step in steps("audit.md"):
            script = f"exec 2>&1\ncd /root\n{step.script}"
            command = ["chroot", str(installed), "bash", "-euo", "pipefail", "-c", script]
            label = f"{step.host}: {step.script.splitlines()[-1]}"
            process = Process(hosts[step.host], command, env=environment, label=label)
            if step.how == "stays":
                staying.append(process)
            else:
                code = process.wait(timeout=90)
                assert (code != 0) == (step.how == "fails"), process.story()
                process.stop()
            for line in step.shown:
                process.wait_for_text(line, timeout=2 * LIMIT)
    finally:
        for process in reversed(staying):
            os.killpg(process.pid, signal.SIGTERM)
            process.stop(timeout=20)
