import json
import os
import re
import shutil
import signal
import ssl
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.network.namespaces import namespaces
from tests.support.command import ROSRV
from tests.support.nodes import need_ros
from tests.support.own_namespace import own_namespace
from tests.support.processes import Process, ThisMachine
from tests.support.requirements import need_root

LIMIT = 600  # for a demonstration that hangs


@pytest.fixture(autouse=True)
def machine() -> None:
    need_root()
    need_ros()


@pytest.fixture
def temporary() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="demo-"))
    folder.chmod(0o755)
    yield folder
    left = list(folder.glob("rosrv-demo-*"))
    shutil.rmtree(folder)  # ROS tools that were interrupted leave files of theirs
    assert not left


def require_no_hosts(pid: int) -> None:
    assert not namespaces(f"rosrv-demo.{pid}.")


def test_demo(tmp_path: Path, temporary: Path) -> None:
    picture = tmp_path / "drive.svg"
    command = [ROSRV, "demo", "--json", "--output", str(picture)]
    output: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=os.environ | {"TMPDIR": str(temporary)}, **output) as demo:
        results_text, story = demo.communicate(timeout=LIMIT)
    said = results_text + story
    assert demo.returncode == 0, said
    assert "NOT OK" not in said
    results = [json.loads(line) for line in results_text.splitlines()]  # the story is on standard error
    assert len(results) > 15
    assert all(result["good"] and result["what"] and result["remark"] for result in results)
    assert "fired one shot" in said
    for line in (
        "denied    take over the operator",
        "denied    forge the trigger",
        "denied    kill a node",
        "denied    try every port",
        "blocked   go past the master",
        "[Commands] default (landshark-demo.ini:",
        "allowed   watch the battery",
        "without a monitor the robot hits itself: 1 shot",
        "with the monitor it does not hit itself: 0 shots",
        "without a monitor it runs into the obstacle",
        "without a monitor it leaves its zone",
        "with the monitor it stops before the obstacle",
        "with the monitor it stops at the zone's border",
        "console:           https://127.0.0.1:",
    ):
        assert line in said
    assert picture.read_text().count("<polyline") == 4, "the drive and the cut link, each without and with"
    require_no_hosts(demo.pid)


def test_the_console_of_the_demo_is_reachable_from_this_machine() -> None:
    with Process(ThisMachine(), [ROSRV, "demo"], env=os.environ, label="rosrv demo") as demo:
        demo.wait_for_text("A LandShark of unmodified", timeout=LIMIT)
        said = demo.story()
        port = re.search(r"https://127\.0\.0\.1:(\d+)/", said)
        token = re.search(r"rosrv_[\w-]+", said)
        assert port and token, said
        unverified = ssl._create_unverified_context()  # noqa: S323  its certificate is in the folder of the demo
        wanted = f"https://127.0.0.1:{port[1]}/v1/status"
        request = urllib.request.Request(wanted, headers={"Authorization": f"Bearer {token[0]}"})
        with urllib.request.urlopen(request, timeout=LIMIT, context=unverified) as answer:  # noqa: S310  https
            assert answer.status == 200
        assert demo.stop(with_signal=signal.SIGTERM, timeout=30) == 130, demo.story()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_demo_interrupted(number: signal.Signals, temporary: Path) -> None:
    environment = os.environ | {"TMPDIR": str(temporary)}
    with Process(ThisMachine(), [ROSRV, "demo"], env=environment, label="rosrv demo") as demo:
        demo.wait_for_text("drove", timeout=LIMIT)
        assert demo.stop(with_signal=number, timeout=30) == 130, demo.story()
    require_no_hosts(demo.pid)


def test_demo_without_space(tmp_path: Path) -> None:
    small = f"mount -t tmpfs -o size=100m tmpfs {tmp_path} && exec {ROSRV} demo"
    command = ["unshare", "--mount", "sh", "-c", small]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert done.returncode == 1
    assert f"needs 160 MiB in {tmp_path}, where 100 MiB are free" in done.stderr
    assert "LandShark" not in done.stderr


def test_demo_without_root() -> None:
    command = ["/usr/bin/setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", ROSRV, "demo"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert "needs root" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.nightly
def test_demo_of_an_adoption(temporary: Path) -> None:
    environment = os.environ | {"TMPDIR": str(temporary)}
    command = [ROSRV, "demo", "--adopt", "--json"]
    with own_namespace():
        done = subprocess.run(
            command,
            env=environment, capture_output=True, text=True, timeout=LIMIT, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(results) == 5
    assert all(result["good"] for result in results)
