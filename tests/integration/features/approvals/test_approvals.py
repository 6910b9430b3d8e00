import json
import os
import pty
import re
import select
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.rosmaster import call_on
from tests.support.waiting import eventually

AGENT = "ws://10.77.0.2:9091"
TWIST = {"linear": {"x": 0.5}}
DRIVES, STOPS = ",0.5,0.0,0.0,0.0,0.0,0.0", ",0.0,0.0,0.0,0.0,0.0,0.0"
POLICY = """
[Groups]
site = 10.77.0.0/24
agent = door:agent-1
[Nodes]
default = site agent
[Publishers]
default = site
/cmd_vel = site, ask agent
[Subscribers]
default = site agent
[Services]
default = site
[Clients]
default = site
/brake = site, ask agent
[Commands]
default = site agent
[Parameters]
read default = site agent
write default = site
write /agent/** = site, ask agent
"""


@pytest.fixture
def appliance(lab: Lab) -> Iterator[Appliance]:
    with Appliance(lab.host("appliance", "10.77.0.2/24"), policy=POLICY) as running:
        running.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
        eventually(lambda: not running.row("door", "list")["trouble"], "the door serves")
        yield running


def agent(robot: Host, *frames: dict[str, Any], answer: str) -> dict[str, Any]:
    def work() -> dict[str, Any]:
        with connect(AGENT) as client:
            for frame in frames:
                client.send(json.dumps(frame))
            while True:
                found: dict[str, Any] = json.loads(client.recv(20.0))
                if found["op"] == answer:
                    return found

    return robot.run(work)


def number_in(text: str) -> str:
    match = re.search(r"held for approval ([0-9]+); ask the operator, then repeat; expires in [0-9]+ s", text)
    assert match, text
    return match[1]


def test_a_call_is_held_approved_used_once_and_held_again(
    appliance: Appliance, robot: Host, tmp_path: Path
) -> None:
    brake = {"op": "call_service", "service": "/brake"}

    def call(on: bool) -> dict[str, Any]:
        return agent(robot, {**brake, "args": [on]}, answer="service_response")

    with RosSession(appliance.master_uri, tmp_path, robot) as ros:
        ros.service_server("roscpp", "/brake")
        held = number_in(call(True)["values"]["message"])
        assert number_in(call(True)["values"]["message"]) == held
        assert number_in(call(False)["values"]["message"]) != held
        assert "{'data': True}: waits" in appliance.rosrv("approve").stdout
        assert "approved by" in appliance.rosrv("approve", held).stdout
        assert call(True)["result"] is True
        again = number_in(call(True)["values"]["message"])
        assert again != held
        appliance.rosrv("approval", "refuse", again)
        assert "an operator refused approval" in call(True)["values"]["message"]
        other = number_in(call(False)["values"]["message"])
        appliance.rosrv("approve", other, "--for", "30s")
        assert call(True)["result"] is True and call(False)["result"] is True
        appliance.rosrv("approval", "refuse", other)
        later = number_in(call(True)["values"]["message"])  # the approval ended the earlier refusal
        assert later not in {again, other}
        number_in(call(False)["values"]["message"])
        appliance.kill("control")
        eventually(
            lambda: "no call waits" in appliance.rosrv("approve", check=False).stdout, "nothing is kept"
        )
        number_in(call(False)["values"]["message"])
    assert appliance.recorded("--event", "approval used")
    assert appliance.recorded("--event", "approval given", count=2)


def test_a_publication_lasts_for_its_time(appliance: Appliance, robot: Host, tmp_path: Path) -> None:
    advertise = {"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist", "id": "a"}
    publish = {"op": "publish", "topic": "/cmd_vel", "msg": TWIST, "id": "p"}
    with RosSession(appliance.master_uri, tmp_path, robot) as ros:
        echo = ros.start(["/usr/bin/rostopic", "echo", "-p", "/cmd_vel"])
        held = number_in(agent(robot, advertise, answer="status")["msg"])
        appliance.rosrv("approve", held, "--for", "5s")

        def work() -> str:
            with connect(AGENT) as client:
                client.send(json.dumps(advertise))
                for _ in range(100):
                    client.send(json.dumps(publish))
                    try:
                        return str(json.loads(client.recv(0.1))["msg"])
                    except TimeoutError:
                        continue
            return "no refusal"

        again = number_in(robot.run(work))
        echo.wait_for_text(DRIVES)
        mark = echo.mark()
        appliance.rosrv("approve", again)
        eventually(lambda: robot.run(lambda: published(publish)) or None, "it is heard again")
        echo.wait_for_text(DRIVES, since=mark)
        appliance.kill("control")
        eventually(
            lambda: "no call waits" in appliance.rosrv("approve", check=False).stdout, "nothing is kept"
        )
        eventually(lambda: "held for" in robot.run(lambda: refused(publish)), "its time is over")


def test_a_door_that_is_added_again_has_no_approval(appliance: Appliance, robot: Host) -> None:
    advertise = {"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist", "id": "a"}
    appliance.rosrv("approve", number_in(agent(robot, advertise, answer="status")["msg"]), "--for", "60s")
    appliance.rosrv("door", "remove", "agent-1")
    appliance.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
    assert "no call waits" in appliance.rosrv("approve").stdout
    eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves again")
    number_in(agent(robot, advertise, answer="status")["msg"])
    assert appliance.recorded("--event", "approval ended")


def test_many_calls_of_a_host_leave_the_agent_its_own(appliance: Appliance, robot: Host, lab: Lab) -> None:
    guest, uri = lab.host("guest", "10.77.0.66/24"), "http://10.77.0.66:1/"
    appliance.reload(POLICY.replace("[Subscribers]", "/goal/** = 10.77.0.10, ask 10.77.0.66\n[Subscribers]"))
    said = [
        call_on(
            guest, appliance.master_uri, "registerPublisher", "/n", f"/goal/{one}", "std_msgs/String", uri
        )[1]
        for one in range(40)
    ]
    assert ["held for approval" in one for one in said] == [number < 8 for number in range(40)]
    advertise = {"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist", "id": "a"}
    held = number_in(agent(robot, advertise, answer="status")["msg"])
    assert "approved by" in appliance.rosrv("approve", held, "--for", "60s").stdout


def published(publish: dict[str, Any]) -> bool:
    return not refused(publish)


def refused(publish: dict[str, Any]) -> str:
    text = ""
    with connect(AGENT) as client:
        client.send(json.dumps({"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist"}))
        for _ in range(20):
            client.send(json.dumps(publish))
            try:
                text = str(json.loads(client.recv(0.1)).get("msg", ""))
            except TimeoutError:
                continue
    return text


def test_a_parameter_is_written_while_an_approval_lasts(appliance: Appliance, robot: Host) -> None:
    write = {
        "op": "call_service",
        "service": "/rosapi/set_param",
        "args": {"name": "/agent/speed", "value": "1"},
    }
    held = number_in(agent(robot, write, answer="service_response")["values"]["message"])
    appliance.rosrv("approve", held, "--for", "20s")
    assert agent(robot, write, answer="service_response")["result"] is True


MOTION = POLICY + "[Authority]\nbase = /cmd_vel\ntake base = site agent\nlease base = 2s\n"


def test_an_approved_motion_ends_by_silence_and_the_guard_stops_the_robot(
    appliance: Appliance, robot: Host, tmp_path: Path
) -> None:
    appliance.reload(MOTION)
    publish = {"op": "publish", "topic": "/cmd_vel", "msg": TWIST, "id": "p"}
    advertise = {"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist", "id": "a"}
    with RosSession(appliance.master_uri, tmp_path, robot) as ros:
        echo = ros.start(["/usr/bin/rostopic", "echo", "-p", "/cmd_vel"])

        def drive() -> None:
            # A door that still has the publication refuses the message, not the advertisement.
            held = number_in(agent(robot, advertise, publish, answer="status")["msg"])
            appliance.rosrv("approve", held, "--for", "60s")
            appliance.rosrv("drive", "assign", "base", "--host", "door:agent-1")
            robot.run(lambda: refused(publish))
            echo.wait_for_text(DRIVES)

        drive()
        [record] = appliance.recorded("--event", "motion not stopped", count=1)[:1]
        assert "nothing stops the robot" in record["reason"]
        appliance.rosrv("guard", "new", "speed", "/cmd_vel", "--type", "command=geometry_msgs/Twist")
        mark = echo.mark()
        drive()
        stops = appliance.recorded("--event", "motion stopped", count=1)
        assert "speed on /cmd_vel" in stops[0]["reason"], stops
        echo.wait_for_text(STOPS, since=mark)
        appliance.reload(MOTION.replace("2s", "60s"))  # the approval does not end by silence
        drive()
        mark = echo.mark()
        appliance.kill("control")
        echo.wait_for_text(STOPS, since=mark)


def test_a_terminal_shows_a_call_with_a_bell_and_its_end(appliance: Appliance, robot: Host) -> None:
    """`rosrv approve --watch` on a terminal, and a call that is held while it runs."""
    ours, theirs = pty.openpty()
    command = (ROSRV, "approve", "--watch", "--state", str(appliance.state))
    watching = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    shown = bytearray()

    def has(text: str) -> bool:
        while select.select([ours], [], [], 0.05)[0]:
            shown.extend(os.read(ours, 4096))
        return text in shown.decode()

    try:
        twist = {"op": "advertise", "topic": "/cmd_vel", "type": "geometry_msgs/Twist", "id": "a"}
        number = number_in(agent(robot, twist, answer="status")["msg"])
        eventually(lambda: has(f"rosrv approve {number} --for 30s"), "the terminal shows the call")
        assert "\a" in shown.decode()
        appliance.rosrv("approval", "refuse", number)
        eventually(lambda: has("refused"), "the terminal shows that it was refused")
        assert shown.decode().count("\a") == 1, "only a call that waits rings"
        watching.send_signal(signal.SIGINT)
        assert watching.wait(20) == 0
    finally:
        watching.kill()
        watching.wait()
        os.close(ours)
