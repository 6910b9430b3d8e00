import itertools
import os
import signal

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
ROLES = ["control", "relay", "rosmaster", "signer", "rosout"]


@pytest.fixture(scope="module")
def appliance(own_appliance: Appliance) -> Appliance:
    return own_appliance


@pytest.mark.real
@pytest.mark.parametrize("role", ROLES)
def test_kill(appliance: Appliance, ros: RosSession, role: str) -> None:
    listeners = [ros.listener(client, "/chatter") for client in CLIENTS]
    ros.talker("rospy", "/chatter", name="python_voice")
    ros.talker("roscpp", "/chatter", name="cpp_voice")
    ros.service_server("roscpp", "/negate")
    clients = [ros.service_client(client, "/negate") for client in CLIENTS]
    ros.run("rosparam", "set", "/kept", role)
    for listener, name in itertools.product(listeners, ("/python_voice", "/cpp_voice")):
        listener.wait_for(event="received", publisher=name)

    killed = appliance.kill(role)
    ros.talker("rospy", "/chatter", name="late_voice")
    for listener in listeners:
        after = listener.mark()
        for name in ("/python_voice", "/cpp_voice", "/late_voice"):
            listener.wait_for(event="received", publisher=name, since=after)
    for client in clients:
        client.send("true")
        client.wait_for(event="answered")
    assert ros.run("rosparam", "get", "/kept").stdout.strip() == role
    assert killed not in appliance.pids(role)
    assert {"/python_voice", "/cpp_voice", "/late_voice"} <= set(ros.run("rosnode", "list").stdout.split())


def test_a_hanging_rosout_is_replaced(appliance: Appliance, ros: RosSession) -> None:
    hanging = eventually(lambda: appliance.pids("rosout"), appliance.story)[0]
    os.kill(hanging, signal.SIGSTOP)
    eventually(lambda: set(appliance.pids("rosout")) - {hanging}, appliance.story)
    eventually(lambda: "xmlrpc reply" in ros.run("rosnode", "ping", "-c1", "/rosout").stdout, appliance.story)
