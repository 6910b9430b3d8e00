"""The cause of a stop is the same true sentence in each place that tells it, and names a node that has ended."""

import json
import math
import re
import signal
from pathlib import Path
from typing import Any

from appliance.channel import admin
from appliance.features.guards.presets import PRESETS, Guard, text_of
from examples.landshark.lab import Host
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import Stream, scans, stream
from tests.support.nodes import RosSession
from tests.support.waiting import eventually

DRIVE = stream("geometry_msgs/Twist", 20, {"linear__x": 0.4})
NEAR = stream(
    "sensor_msgs/LaserScan", 20,
    {"angle_min": -math.pi, "angle_increment": math.pi / 180, "range_min": 0.1, "range_max": 30.0,
     "ranges": [0.6] * 360},
)  # fmt: skip
WANTED = {
    "deadman": "/left of {host} commanded a motion on /a/cmd_vel, and nothing for 0.3\\d s since \\(limit 0.3 s\\)",
    "never": "no message on /never since the guard began",
    "sensor": "no message from /sensors of {host} on /scan for 0.5\\d s \\(limit 0.5 s\\)",
    "separation": "0.45 m are known to be free in the way, and a motion needs more than [01].\\d\\d m, by the scan"
    " from /near of {host} on /near_scan",
}


def guard(name: str, preset: str, **topics: str) -> str:
    given = {**PRESETS[preset].given_topics, **topics}
    return text_of(Guard(name, PRESETS[preset], topics=given))


def test_a_stop_has_its_cause_in_each_place(
    own_appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    texts = {
        "deadman": guard("deadman", "deadman", command="/a/cmd_vel"),
        "never": guard("never", "sensor", command="/b/cmd_vel", by="/never"),
        "sensor": guard("sensor", "sensor", command="/c/cmd_vel", by="/scan"),
        "separation": guard("separation", "separation", command="/d/cmd_vel", by="/near_scan"),
    }
    own_appliance.ask(admin.MonitorLoad({f"{name}.rv": text for name, text in texts.items()}, hold=True))
    with RosSession(own_appliance.master_uri, tmp_path, common_robot) as ros:

        def talker(name: str, **streams: Stream) -> Any:
            node = ros.node("rospy", "frame_talker", name=name)
            node.send(json.dumps([one.on(topic.replace("__", "/")) for topic, one in streams.items()]))
            return node

        topics = ["/a/cmd_vel", "/b/cmd_vel", "/c/cmd_vel", "/d/cmd_vel"]
        ros.node(
            "rospy", "frame_listener", topics[0], "/sensors", *topics[1:], "/scan", "/near_scan", name="base"
        )
        sensors = talker("sensors", **{"/scan": scans(360)})
        talker("near", **{"/near_scan": NEAR})
        left = talker("left", **{"/a/cmd_vel": DRIVE})
        talker("right", **dict.fromkeys(topics[1:], DRIVE))
        eventually(lambda: guards(own_appliance)["separation"]["last_stop"], "the wall stops")
        eventually(
            lambda: moves(own_appliance, "deadman", "sensor"),
            "the bases move, and the first stops have ended",
        )
        own_appliance.ignore_earlier_records()
        left.interrupt(signal.SIGKILL)
        sensors.interrupt(signal.SIGKILL)
        begun = {one["detail"]["monitor"]: one for one in own_appliance.recorded(event="stop begun", count=2)}
        for name in ("deadman", "sensor"):
            wanted = WANTED[name].format(host=re.escape(common_robot.address))
            cause = begun[name]["detail"]["cause"]
            assert re.fullmatch(wanted, cause)
            assert begun[name]["reason"] == f"{name} stops {begun[name]['resource']}: {cause}"
            why = own_appliance.rosrv("audit", "why", begun[name]["id"]).stdout
            assert f"cause: {cause}" in why
            assert f"{'limit' if name == 'deadman' else 'silent ='} 0." in why
        publishers = begun["deadman"]["detail"]["publishers"]
        assert [(one["node"], one["host"]) for one in publishers] == [("/left", common_robot.address)]
        listed = own_appliance.rosrv("guard", "list").stdout
        acting = {one["name"]: one["cause"] for one in own_appliance.status()["guards"]["acting"]}
        assert re.fullmatch(WANTED["never"], acting["never"])
        assert re.fullmatch(
            WANTED["separation"].format(host=re.escape(common_robot.address)), acting["separation"]
        )
        for name, one in guards(own_appliance).items():
            wanted = (
                WANTED[name]
                .format(host=re.escape(common_robot.address))
                .replace("0.3\\d", ".*")
                .replace("0.5\\d", ".*")
            )
            assert re.fullmatch(wanted, one["last_stop"]["cause"])
            assert re.sub(r"\d+\.\d+ s", "", one["last_stop"]["cause"])[:20] in re.sub(r"\s+", " ", listed)


def moves(appliance: Appliance, *names: str) -> bool:
    rows = [guards(appliance)[name] for name in names]
    return all(
        row["state"] == "free" and (row["last_stop"] or {"until": 0})["until"] is not None for row in rows
    )


def guards(appliance: Appliance) -> dict[str, Any]:
    return {row["guard"]: row for row in appliance.rows("guard", "list") if "guard" in row}
