import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.nodes import RosSession
from tests.support.rosmaster import PlainMaster, call_on
from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[RosSession]:
    """A plain master with a talker, a listener and a service, and nothing of the appliance."""
    with PlainMaster(tmp_path) as master, RosSession(master.master_uri, tmp_path) as ros:
        ros.talker("roscpp", "/arm/state", name="driver")
        listener = ros.listener("rospy", "/arm/state", name="watcher")
        ros.service_server("rospy", "/arm/reset", name="server")
        listener.wait_for(event="received")
        eventually(lambda: len(state(ros)[2]) >= 5, "the service is registered")
        yield ros


def state(ros: RosSession) -> Any:
    _code, _text, parts = call_on(ros.host, ros.master_uri, "getSystemState", "/test")
    return [sorted((name, sorted(nodes)) for name, nodes in part) for part in parts]


def rosrv(ros: RosSession, *words: str) -> str:
    return ros.run(sys.executable, "-m", "appliance.cli.main", *words).stdout


def test_a_survey_equals_the_state_of_the_master_and_changes_nothing(
    robot: RosSession, tmp_path: Path
) -> None:
    draft, page = tmp_path / "draft.ini", tmp_path / "survey.html"
    before = state(robot)
    found = json.loads(rosrv(robot, "survey", "--json", "--policy", str(draft), "--output", str(page)))
    assert state(robot) == before
    publishers, subscribers, services = (dict(part) for part in before)
    assert {
        row["name"]: sorted(row["publishers"]) for row in found["topics"] if row["publishers"]
    } == publishers
    assert {
        row["name"]: sorted(row["subscribers"]) for row in found["topics"] if row["subscribers"]
    } == subscribers
    assert {row["name"]: row["providers"] for row in found["services"]} == services
    [topic] = [row for row in found["topics"] if row["name"] == "/arm/state"]
    assert topic["rate"] > 0
    assert all(node["problem"] == "" and node["pid"] for node in found["nodes"])
    rosrv(robot, "policy", "test", str(draft))
    assert "/arm/reset" in page.read_text()
