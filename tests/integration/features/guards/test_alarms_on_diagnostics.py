"""Stock subscribers of `/diagnostics` hear the alarms and the guards' states, beside the robot's own diagnostics."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import stream
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Process

OFF = "rosrv: monitor-off:deadman"


@pytest.fixture
def appliance() -> Iterator[Appliance]:
    need_ros()
    settings = "name: carrier\nalarms_on_diagnostics: true\nrelay:\n  late: 100\n"  # the machine may be busy
    guard = {"deadman": text_of(Guard("deadman", PRESETS["deadman"]))}
    with Appliance(settings=settings, monitors=guard, options=("--api", "off"), relays=2) as appliance:
        yield appliance


def heard(listener: Process, name: str, level: int, since: int = 0) -> dict[str, Any]:
    """Wait until the appliance says an entry with a level, and return all of its entries."""
    said = listener.wait_for(
        lambda one: one.get("publisher") == "/rosrv" and one["statuses"].get(name, {}).get("level") == level,
        since=since,
    )
    assert not said["late"]
    return dict(said["statuses"])


def test_alarms_and_guards_reach_a_stock_subscriber(appliance: Appliance, ros: RosSession) -> None:
    own = stream("diagnostic_msgs/DiagnosticArray", 1, {"status": [{"name": "battery"}]})
    ros.node("rospy", "frame_talker", name="updater").send(json.dumps([own.on("/diagnostics")]))
    listener = ros.node("rospy", "diagnostics_listener")
    listener.wait_for(lambda one: one.get("publisher") == "/updater")
    statuses = heard(listener, "rosrv: alarms", 0)
    assert statuses["rosrv: guards"] == {"level": 0, "message": "1 loaded", "hardware": "carrier"}
    appliance.rosrv("monitor", "disable", "deadman")
    statuses = heard(listener, OFF, 1)
    assert statuses["rosrv: alarms"]["message"] == statuses[OFF]["message"]
    assert statuses[OFF]["message"] in appliance.rosrv("alarm", "list").stdout
    mark = listener.mark()
    appliance.rosrv("monitor", "enable", "deadman")
    assert heard(listener, OFF, 0, mark)[OFF]["message"] == "ended"
    statuses = heard(listener, "rosrv: alarms", 0, listener.mark())
    assert OFF not in statuses and "deadman has limited or stopped" in statuses["rosrv: guards"]["message"]
    for role in ("relay", "control"):
        appliance.kill(role)
        heard(
            listener, "rosrv: guards", 1, listener.mark()
        )  # that it acted late while there was no relay is an alarm
    assert "* /rosrv " in ros.run("/usr/bin/rostopic", "info", "/diagnostics").stdout
