"""A proof test in a deployed appliance: copies act, the host of the driver acknowledges the stop, no guard changes."""

import json
from pathlib import Path
from typing import Any

from appliance.channel import admin
from appliance.features.guards.presets import PRESETS, Guard, text_of
from examples.landshark.lab import Host
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import OFF, PRESSED, VELOCITY, Stream, stream
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

ZERO = stream("geometry_msgs/Twist", 10, {})
ACTS = {"deadman": "stopped", "estop": "stopped", "limit": "limited"}


def guards(appliance: Appliance) -> dict[str, Any]:
    return {row["guard"]: row for row in appliance.rows("guard", "list") if "guard" in row}


def values(appliance: Appliance, guard: str) -> dict[str, object]:
    return appliance.ask(admin.MonitorValuesWanted(guard)).values


def counted(base: Process) -> int:
    """Return how many messages of the appliance's own node the base has got on /cmd_vel."""
    mark = base.mark()
    base.send("")
    return int(base.wait_for(event="counted", since=mark)["heard"]["/cmd_vel"])


def test_copies_act_and_the_stop_reaches_the_driver_of_a_standing_robot(
    own_appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    texts = {
        "deadman": text_of(Guard("deadman", PRESETS["deadman"], values={"silent": "1"})),
        "estop": text_of(Guard("estop", PRESETS["estop"], values={"publishers": "1"})),
        "limit": text_of(Guard("limit", PRESETS["speed"])),
    }

    def load(*names: str) -> None:
        own_appliance.ask(admin.MonitorLoad({f"{name}.rv": texts[name] for name in names}, hold=True))

    load("limit")
    with RosSession(own_appliance.master_uri, tmp_path, common_robot) as ros:

        def talker(name: str, **streams: Stream) -> Process:
            node = ros.node("rospy", "frame_talker", name=name)
            node.send(json.dumps([one.on(f"/{topic}") for topic, one in streams.items()]))
            return node

        def test(*names: str, status: int = 0) -> str:
            done = own_appliance.rosrv("guard", "test", *names, "--json", check=False)
            assert done.returncode == status, done.stdout + done.stderr
            return done.stdout + done.stderr

        base = ros.node("rospy", "frame_listener", "/cmd_vel", "/rosrv", "/cmd_vel", name="base")
        talker("button", emergency_stop=OFF, emergency_stop_reset=PRESSED)
        assert "not known to stand still" in test("limit", status=1)
        load("deadman", "estop")  # which stop the base at first
        teleop = talker("teleop", cmd_vel=ZERO)
        eventually(lambda: guards(own_appliance)["deadman"]["times"], "the guards judge commands")
        states, heard = guards(own_appliance), counted(base)
        rows = {one["guard"]: one for one in map(json.loads, test().splitlines())}
        assert {name: row["test"]["outcome"] for name, row in rows.items()} == ACTS
        for one in rows.values():
            reached = {row["node"]: row for row in one["test"]["reached"]}
            assert reached["/base"]["driver"]
            assert 0 < reached["/base"]["accepted"] <= reached["/base"]["acknowledged"] < 1
        eventually(lambda: counted(base) == heard + len(ACTS), "the base got one stop of each test")
        assert base.seen(event="moves") == []
        state = values(own_appliance, "estop")
        assert state["buttons"] == ["/button"] and "/test_robot" not in str(state)
        assert {name: guard["stops"] for name, guard in guards(own_appliance).items()} == {
            name: one["stops"] for name, one in states.items()
        }
        records = own_appliance.recorded(event="guard tested", count=3)
        assert {record["detail"]["monitor"]: record["detail"]["digest"] for record in records} == {
            name: one["digest"] for name, one in states.items()
        }
        teleop.stop()
        driving = talker("driving", cmd_vel=VELOCITY)
        eventually(lambda: base.seen(event="moves"), "the base moves")
        assert "/driving drives on /cmd_vel" in test("estop", status=1)
        driving.stop()
        own_appliance.ask(admin.MonitorSwitch(["limit"], False))
        assert "not in force" in test("limit", status=1)
        own_appliance.stop()
        own_appliance.start()
        kept = {name: guard["tested"]["outcome"] for name, guard in guards(own_appliance).items()}
        assert kept == ACTS
        manual = own_appliance.rosrv("guard", "manual").stdout
        assert manual.count("acknowledged the stop") == len(ACTS)
