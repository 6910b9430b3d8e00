"""roslib from npm, as browsers use it, and roslibpy from PyPI, at the door of a running appliance."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.operations import request_named
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.requirements import need_program
from tests.support.waiting import eventually

APPROVALS: Any = request_named("approvals")
HERE = Path(__file__).with_name("roslib")
IN_PYTHON = Path(__file__).with_name("roslibpy")
UV = Path(sys.executable).with_name("uv")
POLICY = """
[Groups]
site = 10.77.0.0/24
agent = door:agent-1
[Nodes]
default = site agent
[Publishers]
default = site
/answer = site agent
/held = site, ask agent
[Subscribers]
default = site agent
[Services]
default = site
[Clients]
default = site
/brake = site agent
[Commands]
default = site agent
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program beside the libraries of its lock file."""
    npm = need_program("npm", "npm")
    folder = tmp_path_factory.mktemp("roslib")
    for file in HERE.iterdir():
        shutil.copy(file, folder)
    subprocess.run(
        [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"], cwd=folder, check=True
    )
    return folder / "client.mjs"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of an environment with roslibpy, as its lock file says."""
    place = tmp_path_factory.mktemp("roslibpy") / "venv"
    python, lock = place / "bin/python", IN_PYTHON / "requirements.lock"
    for command in (
        ["venv", "--python", sys.executable, str(place)],
        ["pip", "sync", "--require-hashes", "--python", str(python), str(lock)],
    ):
        subprocess.run([UV, "--quiet", *command], check=True, timeout=240)
    return python


@pytest.fixture(scope="module")
def place(common_lab: Lab) -> Host:
    return common_lab.host("appliance", "10.77.0.2/24")


@pytest.fixture
def appliance(place: Host) -> Iterator[Appliance]:
    with Appliance(place, policy=POLICY) as running:
        running.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
        eventually(lambda: not running.row("door", "list")["trouble"], "the door serves")
        yield running


@pytest.fixture
def ros(appliance: Appliance, common_robot: Host, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(appliance.master_uri, tmp_path, common_robot) as session:
        session.talker("roscpp", "/chatter")
        session.service_server("roscpp", "/brake")
        session.service_server("roscpp", "/forbidden_brake")
        yield session


def refusal(client: Process, topic: str) -> str:
    found = client.wait_for(lambda event: topic in str(event.get("words")), event="status", level="error")
    return str(found["words"])


def test_roslib_uses_a_door_and_shows_why_it_is_refused(
    appliance: Appliance, ros: RosSession, program: Path
) -> None:
    """It hears, publishes and calls within its rights, gets refusals in words, and gets through after a yes."""
    answers, held = ros.listener("rospy", "/answer"), ros.listener("rospy", "/held")
    client = ros.start(["/usr/bin/node", str(program), "ws://10.77.0.2:9091"], label="roslib")
    assert client.wait_for(event="heard")["data"].startswith("hello ")
    assert answers.wait_for(event="received")["data"] == "to /answer"
    assert client.wait_for(event="answered", service="/brake")["success"] is False
    refused = client.wait_for(event="not answered", service="/forbidden_brake")
    assert "198.19.240." in str(refused["error"]) and "policy.ini" in str(refused["error"])
    assert "policy.ini" in refusal(client, "/forbidden")
    words = refusal(client, "/held")
    number = re.search(r"held for approval ([0-9]+); ask the operator", words)
    assert number is not None, words
    appliance.rosrv("approve", number[1], "--for", "60s")
    assert held.wait_for(event="received")["data"] == "to /held"


def test_roslibpy_uses_a_door_and_gets_the_words_when_it_ends(
    appliance: Appliance, ros: RosSession, python: Path
) -> None:
    """roslibpy shows a program no `status`: only the error of a call, and the reason in the closing frame."""
    answers, held = ros.listener("rospy", "/answer"), ros.listener("rospy", "/held")
    command = [str(python), str(IN_PYTHON / "client.py"), "10.77.0.2", "9091"]
    client = ros.start([*command, "/answer", "/held"], label="roslibpy")
    assert client.wait_for(event="heard")["data"].startswith("hello ")
    assert answers.wait_for(event="received")["data"] == "to /answer"
    assert client.wait_for(event="answered", service="/brake")["success"] is False
    refused = client.wait_for(event="not answered", service="/forbidden_brake")
    assert "198.19.240." in str(refused["error"]) and "policy.ini" in str(refused["error"])
    approvals = eventually(
        lambda: [one for one in appliance.ask(APPROVALS()).approvals if one.resource == "/held"],
        "the call waits for an approval",
    )
    appliance.rosrv("approve", str(approvals[0].number), "--for", "60s")
    assert held.wait_for(event="received")["data"] == "to /held"
    denied = ros.start([*command, "/forbidden"], label="roslibpy, denied")
    denied.wait_for(event="closed")
    closing = denied.wait_for(lambda event: "Code=1008" in str(event.get("text")), event="logged")
    assert "100 refusals in 30 s" in str(closing["text"]) and "/forbidden" in str(closing["text"])
