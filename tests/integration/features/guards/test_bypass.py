"""A process that gives a base other publishers, past the appliance, is an alarm."""

import socket
import xmlrpc.client
from collections.abc import Iterator
from http.client import HTTPException
from pathlib import Path
from typing import Any, cast
from xml.parsers.expat import ExpatError

import pytest

from appliance.channel.admin import StatusWanted
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.network.listening_sockets import listening_ports
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.rosmaster import PlainMaster, await_node, call_on
from tests.support.waiting import eventually

PUBLISH = ["/usr/bin/rostopic", "pub", "-r", "20", "/cmd_vel", "geometry_msgs/Twist"]


@pytest.fixture(scope="module")
def guarded(common_lab: Lab) -> Iterator[Appliance]:
    deadman = text_of(Guard("deadman", PRESETS["deadman"]))
    host = common_lab.host("bypassed", "10.77.0.6/24")
    with Appliance(host, options=("--api", "off"), monitors={"deadman": deadman}) as running:
        yield running


def state(appliance: Appliance) -> Any:
    return cast(Any, appliance.ask(StatusWanted())).guards


def api_of(host: Host, topic: str) -> str:
    """Return the URI of the node that subscribes to the topic, as every process on its machine finds it."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(1.0)  # a TCPROS port does not answer
    try:
        for port in host.run(listening_ports):
            uri = f"http://{host.address}:{port}/"
            try:
                subscribed = call_on(host, uri, "getSubscriptions", "/probe")[2]
            except (OSError, xmlrpc.client.Error, HTTPException, ExpatError):
                continue
            if topic in {name for name, _kind in subscribed}:
                return uri
    finally:
        socket.setdefaulttimeout(before)
    return ""


def reported(appliance: Appliance) -> list[Any]:
    return [(one.topic, one.node, one.host, one.publishers) for one in state(appliance).bypassed]


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_a_base_that_takes_commands_past_its_guard_is_an_alarm(
    guarded: Appliance, common_robot: Host, tmp_path: Path, client: str
) -> None:
    (tmp_path / "rogue").mkdir()
    with RosSession(guarded.master_uri, tmp_path, common_robot) as ros:
        if client == "rospy":
            ros.node("rospy", "driven_base", "0", name="base")
        else:
            ros.start(["/usr/lib/topic_tools/relay", "/cmd_vel", "/moved", "__name:=base"])
        ros.start([*PUBLISH, "{}"])
        place = f"/cmd_vel: the base is on {common_robot.address}: if that is another machine than this container's, "
        eventually(
            lambda: [one.partition("a cut")[0] for one in state(guarded).elsewhere] == [place], "the place"
        )
        base = eventually(lambda: api_of(common_robot, "/cmd_vel"), "the base has an API")
        with PlainMaster(tmp_path / "rogue", common_robot) as master:
            rogue = RosSession(master.master_uri, tmp_path / "rogue", common_robot)
            rogue.start([*PUBLISH, "{linear: {x: 7}}", "__name:=rogue"])
            await_node(master.master_uri, common_robot, "/rogue")
            theirs = [call_on(common_robot, master.master_uri, "lookupNode", "/probe", "/rogue")[2]]
            assert state(guarded).bypassed == []
            expected = ("/cmd_vel", "/base", common_robot.address, theirs)

            def bypassed() -> bool:
                """Give the base another publisher again and again: the appliance soon gives a roscpp node its own."""
                call_on(common_robot, base, "publisherUpdate", "/master", "/cmd_vel", theirs)
                return reported(guarded) == [expected]

            eventually(bypassed, "the bypass is reported", 60)
            rogue.__exit__(None, None, None)
    eventually(lambda: state(guarded).bypassed == [], "the end of the node is seen", 40)
