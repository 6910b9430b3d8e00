import json
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from examples.landshark.lab import Lab
from tests.support.features.standby.standby_site import ADDRESSES, OCU, ROBOT, StandbySite
from tests.support.nodes import need_ros
from tests.support.requirements import need_root
from tests.support.waiting import eventually

POLICY = f"""\
[Groups]
site = 10.79.0.0/24
viewer = door:viewer
[Nodes]
default = site viewer
[Publishers]
default = site
[Subscribers]
default = site viewer
[Commands]
default = site viewer
[Authority]
base = /cmd_vel
take base = {ROBOT} {OCU}
lease base = 60s
"""
TWIST = ("rostopic", "pub", "-r", "20", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.3}}")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[StandbySite]:
    need_root()
    need_ros()
    settings, rest = "api_networks: [10.79.0.0/24]\n", ("--api", "0.0.0.0:8443")
    with (
        Lab("rosrv-features") as lab,
        StandbySite(lab, tmp_path, policy=POLICY, settings=settings, monitors={}, options=rest) as made,
    ):
        made.begin()
        yield made


def guards(site: StandbySite, name: str) -> dict[str, Any]:
    return {row["name"]: row for row in site.appliances[name].rows("monitor", "list")}


def test_a_door_a_held_group_and_guards(site: StandbySite) -> None:
    a, b = site.appliances["a"], site.appliances["b"]
    tablet = site.lab.host("ocu", f"{OCU}/24")
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE

    def watched(name: str, path: str) -> bool:
        try:
            with connect(f"wss://{ADDRESSES[name]}:8443{path}", ssl=trusting) as viewer:
                viewer.send(json.dumps({"op": "subscribe", "topic": "/state", "type": "std_msgs/String"}))
                return "hello" in str(viewer.recv(10))
        except (OSError, WebSocketException):
            return False  # the appliance is still the standby, or the door starts

    with site.ros() as ros:
        ros.start(list(TWIST), label="driver")
        ros.talker("rospy", "/state")
        a.rosrv("door", "add", "viewer")
        path = a.rosrv("door", "ticket", "viewer").stdout.strip().partition("ADDRESS:8443")[2]
        assert tablet.run(lambda: eventually(lambda: watched("a", path), site.story))
        a.rosrv("drive", "assign", "base", "--host", ROBOT)
        a.rosrv("guard", "new", "speed", "/cmd_vel", "vMax=0.2")
        a.rosrv("guard", "new", "deadman", "/cmd_vel", "--shadow")
        eventually(lambda: b.rosrv("standby", "status", check=False).returncode == 0, site.story)
        site.cut("a")
        site.until_taken_over("b")
        assert tablet.run(lambda: eventually(lambda: watched("b", path), site.story))
        assert not b.row("drive", "status")["groups"][0]["holder"]
        assert {name: row["shadow"] for name, row in guards(site, "b").items()} == {
            "speed": False,
            "deadman": True,
        }
        changed = guards(site, "b")["speed"]["changes"]
        b.rosrv("drive", "assign", "base", "--host", ROBOT)
        eventually(lambda: guards(site, "b")["speed"]["changes"] > changed + 10, site.story)
