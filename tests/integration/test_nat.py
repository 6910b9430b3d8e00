"""Nodes of a container's network, whose host translates their addresses: no other host can connect to them."""

import signal
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from appliance.channel.admin import GraphWanted
from appliance.network import interfaces
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, need_ros
from tests.support.requirements import need_root
from tests.support.rosmaster import call_on
from tests.support.translators import TRANSLATORS, guest_behind, load
from tests.support.waiting import eventually

pytestmark = pytest.mark.usefixtures("ros_of_robot")
NAT = "10.77.0.20"
CLIENTS: list[Client] = ["rospy", "roscpp"]
SETTINGS = "liveness: {interval: 0.5, silent: 3, shadow: 2}\n"
DROP = "add table inet wall; add chain inet wall in { type filter hook input priority 0; }; "
DROP += "add rule inet wall in ip saddr 10.77.0.2 tcp flags & (syn | ack) == syn drop"
REJECT = f"{DROP.removesuffix('drop')}reject with tcp reset"


@pytest.fixture(scope="module", params=["refuses", "drops"])
def laptop(request: pytest.FixtureRequest) -> Iterator[tuple[Lab, Host]]:
    need_root()
    need_ros()
    with Lab("rosrv-test") as lab:
        laptop, guest = lab.host("laptop", f"{NAT}/24"), lab.host("guest", "10.76.0.2/24")
        interfaces.delete_link(guest.namespace, "eth0")
        if request.param == "drops":
            load(laptop.namespace, "nft", DROP)
        yield lab, guest_behind(laptop.namespace, guest.namespace, TRANSLATORS[0])


@pytest.fixture(scope="module")
def appliance(laptop: tuple[Lab, Host]) -> Iterator[Appliance]:
    with Appliance(laptop[0].host("master", "10.77.0.2/24"), settings=SETTINGS) as one:
        yield one


@pytest.fixture(scope="module")
def ros_of_robot(
    appliance: Appliance, laptop: tuple[Lab, Host], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RosSession]:
    robot = laptop[0].host("robot", "10.77.0.10/24")
    with RosSession(appliance.master_uri, tmp_path_factory.mktemp("robot"), robot) as ros:
        ros.talker("roscpp", "/chatter")
        ros.talker("rospy", "/map", "--latch")
        ros.service_server("roscpp", "/negate")
        yield ros


@pytest.fixture
def ros(appliance: Appliance, laptop: tuple[Lab, Host], tmp_path: Path) -> Iterator[RosSession]:
    appliance.ignore_earlier_records()
    with RosSession(appliance.master_uri, tmp_path, laptop[1]) as session:
        yield session


def test_a_tool_behind_nat_hears_what_is_there(appliance: Appliance, ros: RosSession, tmp_path: Path) -> None:
    assert "hello" in ros.run("rostopic", "echo", "-n", "1", "/chatter/data").stdout
    bag = tmp_path / "all.bag"
    record = ros.start(["rosbag", "record", "-O", str(bag), "/chatter", "/map"])
    opened = appliance.recorded(event="connection opened", host=NAT, count=3)
    registered = appliance.recorded(event="registered", host=NAT, category="subscription", count=3)
    assert all("hears of no later change" in row["reason"] for row in registered), registered
    for topic in ("/chatter", "/map"):
        subscribed, connected = (
            max(datetime.fromisoformat(row["time"]) for row in rows if row["resource"] == topic)
            for rows in (registered, opened)
        )
        assert connected - subscribed < timedelta(seconds=2)
    ros.listener("roscpp", "/chatter").wait_for_count(20, event="received")
    record.stop(with_signal=signal.SIGINT, timeout=30)
    for topic in ("/chatter", "/map"):
        assert "hello" in ros.run("rostopic", "echo", "-b", str(bag), "-n", "1", topic).stdout


def states_of(appliance: Appliance, name: str) -> set[str]:
    return {node.state for node in appliance.ask(GraphWanted()).nodes if node.name == name}


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_a_subscriber_behind_nat_stays_while_connected(
    appliance: Appliance, ros: RosSession, client: Client
) -> None:
    ear = ros.listener(client, "/chatter", name="ear")
    ear.wait_for(event="received")
    began = time.monotonic()
    while time.monotonic() < began + 8:
        ear.wait_for(event="received", since=ear.mark())
        assert "live" in states_of(appliance, "/ear")
    assert (
        "received by /ear; it cannot be called (NAT)" in appliance.rosrv("topic", "info", "/chatter").stdout
    )
    ear.kill()
    began = time.monotonic()
    eventually(lambda: "live" not in states_of(appliance, "/ear"), "it is lost")
    (lost,) = appliance.recorded(event="node lost", caller_id="/ear")
    assert "it has no connection to a relay" in lost["reason"]


@pytest.mark.parametrize(("number", "wall"), [(31, REJECT), (32, DROP)], ids=["rejects", "drops"])
def test_a_subscriber_behind_a_firewall_stays_while_connected(
    appliance: Appliance, laptop: tuple[Lab, Host], tmp_path: Path, number: int, wall: str
) -> None:
    walled = laptop[0].host(f"walled{number}", f"10.77.0.{number}/24")
    load(walled.namespace, "nft", wall)
    with RosSession(appliance.master_uri, tmp_path, walled) as ros:  # its nodes have ROS_IP
        ears = [ros.listener(client, "/chatter", name=f"{client}_{number}") for client in CLIENTS]
        began = time.monotonic()
        while time.monotonic() < began + 8:
            for ear in ears:
                ear.wait_for(event="received", since=ear.mark())
        for client in CLIENTS:
            assert states_of(appliance, f"/{client}_{number}") == {"live"}


def test_a_client_behind_nat_calls_a_service(ros: RosSession) -> None:
    client = ros.service_client("rospy", "/negate")
    client.send("true")
    assert client.wait_for(event="answered")


def test_a_publisher_behind_nat_gets_the_ways_out(appliance: Appliance, ros: RosSession) -> None:
    done = ros.run("rostopic", "pub", "-1", "/told", "std_msgs/String", "data: x", check=False, timeout=20)
    (denied,) = appliance.recorded(event="decision", decision="deny", resource="/told")
    for way in ("--network host", f"ROS_IP={NAT}", "a tunnel"):
        assert way in denied["reason"]
        assert way in done.stderr


def test_nodes_of_another_master_are_refused(appliance: Appliance, laptop: tuple[Lab, Host]) -> None:
    call = {
        "methodName": "registerSubscriber",
        "params": ["/far", "/chatter", "std_msgs/String", "http://robot2:4000/"],
    }
    (((code, text, _value),),) = call_on(laptop[1], appliance.master_uri, "system.multicall", [call])
    assert (code, "multimaster_fkie" in text) == (0, True)
