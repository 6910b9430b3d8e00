import json
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession
from tests.support.waiting import eventually

MONITOR = """
censor() {
    event said(std::string text) /TOPIC std_msgs/String '{data:text}' { text = "checked " + text; }
}
"""


def echoed(appliance: Appliance, *arguments: str) -> list[dict[str, object]]:
    done = appliance.rosrv("topic", "echo", *arguments, "--json")
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_echo_shows_the_subscribers_messages_and_is_recorded(
    appliance: Appliance, ros: RosSession, client: Client, tmp_path: Path
) -> None:
    topic = f"/{client}_chatter"
    ros.talker(client, topic, "--text", "word", name="voice").wait_for(event="ready")
    shown = echoed(appliance, topic, "-n", "3")
    assert [row["node"] for row in shown] == ["/voice"] * 3
    echoed(appliance, topic)  # further queries of the same viewer are not recorded
    assert all("word" in str(row["fields"]) for row in shown)
    [record] = appliance.recorded("--event", "topic looked into", "--topic", topic)
    assert record["detail"] == {"who": "operator", "seconds": 60.0}
    specification = tmp_path / "censor.rv"
    specification.write_text(MONITOR.replace("/TOPIC", topic))
    appliance.rosrv("monitor", "load", str(specification))
    assert "checked" in str(echoed(appliance, topic, "--field", "data")[0]["fields"])
    appliance.rosrv("monitor", "remove", "censor")


def test_over_rest_it_is_for_operators(appliance: Appliance, ros: RosSession) -> None:
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
    appliance.rosrv("token", "revoke", "eve")


def test_a_silent_topic_ends_and_blocks_no_other_request(appliance: Appliance, ros: RosSession) -> None:
    ros.listener("roscpp", "/quiet", name="ear").wait_for(event="ready")
    eventually(
        lambda: appliance.rosrv("topic", "info", "/quiet", check=False).returncode == 0, lambda: "no topic"
    )
    done = appliance.rosrv("topic", "echo", "/quiet", "--within", "0.5s", check=False)
    assert done.returncode == 1
    assert "no message of /quiet in 0.5 s" in done.stderr
