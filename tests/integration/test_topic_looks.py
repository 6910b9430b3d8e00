"""Looking into the topics of real nodes: over the command line and REST, by whom it is for, and on record."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, has_ros
from tests.support.requirements import needs
from tests.support.waiting import eventually

MONITOR = """
censor() {
    event said(std::string text) /TOPIC std_msgs/String '{data:text}' { text = "checked " + text; }
}
"""


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    """An appliance with REST and no monitors yet; each test has topics of its own."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


@pytest.fixture
def ros(appliance: Appliance, tmp_path: Path) -> Iterator[RosSession]:
    """Nodes of one test."""
    with RosSession(appliance.master_uri, tmp_path) as session:
        yield session


def echoed(appliance: Appliance, *arguments: str) -> list[dict[str, object]]:
    """What `rosrv topic echo --json` shows."""
    done = appliance.rosrv("topic", "echo", *arguments, "--json")
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_what_subscribers_get_is_shown_and_recorded(
    appliance: Appliance, ros: RosSession, client: Client, tmp_path: Path
) -> None:
    """Before and after a monitor changes it; nobody subscribes, and the publisher need not."""
    topic = f"/{client}_chatter"
    ros.talker(client, topic, "--text", "word", name="voice").wait_for(event="ready")
    shown = echoed(appliance, topic, "-n", "3")
    assert [row["node"] for row in shown] == ["/voice"] * 3
    echoed(appliance, topic)  # whoever looks on is not recorded again
    assert all("word" in str(row["fields"]) for row in shown)
    [record] = appliance.recorded("--event", "topic looked into", "--topic", topic)
    assert record["detail"] == {"who": "operator", "seconds": 60.0}
    specification = tmp_path / "censor.rv"
    specification.write_text(MONITOR.replace("/TOPIC", topic))
    appliance.rosrv("monitor", "load", str(specification))
    assert "checked" in str(echoed(appliance, topic, "--field", "data")[0]["fields"])


def test_a_latched_message_is_shown_once(appliance: Appliance, ros: RosSession) -> None:
    """However many more are waited for; what comes after it is a new one."""
    ros.talker("rospy", "/map", "--latch", "--count", "1", name="server").wait_for(event="ready")
    done = appliance.rosrv("topic", "echo", "/map", "-n", "3", "--seconds", "1", "--json", check=False)
    assert (done.returncode, len(done.stdout.splitlines())) == (1, 1)


def test_over_rest_it_is_for_operators(appliance: Appliance, ros: RosSession) -> None:
    """A viewer is told so; the answer names type, publishers and subscribers; bounds and unknown topics are refused."""
    ros.talker("rospy", "/chatter", name="voice").wait_for(event="ready")
    ros.listener("roscpp", "/chatter", name="ear").wait_for(event="ready")
    rest = appliance.rest()
    viewer = appliance.rest(
        json.loads(appliance.rosrv("token", "add", "eve", "--role", "viewer", "--json").stdout)["token"]
    )
    assert viewer.get("/v1/messages?topic=/chatter").status == 403
    body = rest.get("/v1/messages?topic=/chatter&messages=2&seconds=5").json
    assert (body["type"], body["publishers"], body["subscribers"]) == (
        "std_msgs/String",
        ["/voice"],
        ["/ear"],
    )
    assert len(body["messages"]) == 2
    assert rest.get("/v1/messages?topic=/nobody").status == 404
    assert rest.get("/v1/messages?topic=/chatter&messages=21").status == 422


def test_silence_ends_and_holds_nobody_up(appliance: Appliance, ros: RosSession) -> None:
    """A topic that nobody publishes on: status 1 after the time; meanwhile others are answered."""
    ros.listener("roscpp", "/quiet", name="ear").wait_for(event="ready")
    eventually(
        lambda: appliance.rosrv("topic", "info", "/quiet", check=False).returncode == 0, lambda: "no topic"
    )
    done = appliance.rosrv("topic", "echo", "/quiet", "--seconds", "0.5", check=False)
    assert done.returncode == 1
    assert "no message of /quiet in 0.5 s" in done.stderr
