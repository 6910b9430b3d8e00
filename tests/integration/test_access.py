"""The thesis's attacks on the LandShark (its research question 3), with real nodes on two machines.

Only the first machine may publish the topic, and the second must not end a node of the first.
"""

from collections.abc import Iterator

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.rosmaster import call_on

POLICY = """\
[Groups]
first  = 10.77.0.10
second = 10.77.0.66

[Nodes]
default = first second

[Publishers]
default = first second
/topic1 = first

[Subscribers]
default = first second

[Commands]
default  = first second
shutdown = first
"""


@pytest.fixture(scope="module")
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    need_ros()
    host = common_lab.host("appliance", "10.77.0.2/24")
    with Appliance(host, policy=POLICY, options=("--api", "off")) as running:
        yield running


@pytest.fixture(scope="module")
def second(common_lab: Lab) -> Host:
    return common_lab.host("second", "10.77.0.66/24")


@pytest.mark.real
def test_publisher_of_the_wrong_machine(appliance: Appliance, ros: RosSession, second: Host) -> None:
    listener = ros.listener("roscpp", "/topic1")
    ros.talker("rospy", "/topic1", name="rightful")
    answer = call_on(
        second,
        appliance.master_uri,
        "registerPublisher",
        "/forged",
        "/topic1",
        "*",
        "http://10.77.0.66:40404/",
    )
    assert (answer[0], type(answer[2])) == (0, list)
    assert "[Publishers] /topic1" in answer[1]
    heard = listener.wait_for_count(5, event="received")
    assert {event["publisher"] for event in heard} == {"/rightful"}
    (record,) = appliance.recorded("--deny", resource="/topic1", caller_id="/forged")
    assert (record["host"], record["caller_id"], record["category"]) == ("10.77.0.66", "/forged", "publish")
    assert (record["rule"]["section"], record["rule"]["key"]) == ("Publishers", "/topic1")
    assert record["rule"]["line"] == POLICY.splitlines().index("/topic1 = first") + 1


@pytest.mark.real
def test_second_machine_may_publish_elsewhere(ros: RosSession, second: Host) -> None:
    listener = ros.listener("rospy", "/topic2")
    ros.on(second).talker("roscpp", "/topic2", name="guest")
    assert listener.wait_for(event="received")["publisher"] == "/guest"


@pytest.mark.real
def test_kill_from_the_wrong_machine(appliance: Appliance, ros: RosSession, second: Host) -> None:
    talker = ros.talker("roscpp", "/topic1", name="driver")
    listener = ros.listener("rospy", "/topic1")
    ros.on(second).run("rosnode", "kill", "/driver", check=False)
    assert appliance.recorded("--deny", host="10.77.0.66", resource="shutdown")
    listener.wait_for(event="received", since=listener.mark())
    assert talker.running
    ros.run("rosnode", "kill", "/driver")
    talker.wait()


@pytest.mark.real
def test_name_of_another_machines_node(appliance: Appliance, ros: RosSession, second: Host) -> None:
    listener = ros.listener("rospy", "/topic2")
    ros.talker("rospy", "/topic2", "--text", "mine", name="voice")
    listener.wait_for(event="received")
    answer = call_on(
        second,
        appliance.master_uri,
        "registerPublisher",
        "/voice",
        "/topic2",
        "*",
        "http://10.77.0.66:40404/",
    )
    assert answer[0] == 0
    after = listener.wait_for(event="received", since=listener.mark())
    assert after["data"].startswith("mine")


def test_rest_can_be_disabled(appliance: Appliance) -> None:
    assert appliance.ready["api"] is None
    assert "token" not in appliance.ready
    assert appliance.pids("api") == []
