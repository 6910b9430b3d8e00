import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from examples.landshark.drive import MISSION, SHIPPED, TRIGGERED, VELOCITY, Drive, Part, Simulation, record
from examples.landshark.messages import MONITORS, Messages
from examples.landshark.nodes import physics
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import rosrv
from tests.support.nodes import PYTHON, ROOT, RosSession, need_ros
from tests.support.waiting import eventually

NODES = ROOT / "examples" / "landshark" / "nodes"
OBSTACLE = physics.YARD[0]
SLACK = (
    2.0 * physics.COMMAND_LIFETIME + 0.2
)  # metres: the base obeys the last command for half a second, at 2 m/s
Record = dict[str, Any]


def specification(name: str) -> tuple[Path, ...]:
    return (MONITORS / f"{name}.rv",)


@pytest.fixture(scope="module")
def unguarded() -> Drive:
    return Simulation().run()


@pytest.fixture(scope="module")
def bag(unguarded: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "drive.bag"
    record(unguarded, path)
    return path


def replayed(bag: Path, *files: Path, output: Path | None = None) -> list[Record]:
    written = ("--output", str(output)) if output else ()
    done = rosrv("monitor", "run", *map(str, files), "--bag", str(bag), "--json", *written)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_the_mission_fails_without_monitors(unguarded: Drive) -> None:
    assert unguarded.nearest(OBSTACLE) < 0
    assert unguarded.farthest() > 24
    assert [shot.fired for shot in unguarded.shots] == [True, True, True]
    assert min(shot.tilt for shot in unguarded.shots) < -0.45


def test_safe_triggering(unguarded: Drive) -> None:
    guarded = Simulation(specification("safe_triggering")).run()
    assert [shot.fired for shot in guarded.shots] == [True, False, True]
    assert guarded.poses == unguarded.poses
    assert [message.data for message in guarded.messages] == [message.data for message in unguarded.messages]
    assert [message.topic for message in guarded.messages if message.result != "passed"] == [TRIGGERED]


def test_safe_zone(unguarded: Drive) -> None:
    guarded = Simulation(specification("safe_zone")).run()
    assert 20 < guarded.farthest() < 20 + SLACK
    end = guarded.poses[-1]
    assert math.hypot(end.x, end.y) < 19
    first = next(message for message in guarded.messages if message.result == "dropped")
    outside = next(index for index, pose in enumerate(unguarded.poses) if math.hypot(pose.x, pose.y) > 20)
    late = first.time - unguarded.messages[0].time - outside * 50_000_000
    assert 0 <= late <= 101_000_000  # the next command after the border was crossed
    assert first.topic == VELOCITY


def test_obstacle_avoidance() -> None:
    guarded = Simulation(specification("obstacle_avoidance")).run()
    assert 0.3 < guarded.nearest(OBSTACLE) < 1.3
    alarms = [message for message in guarded.messages if message.topic == "/landshark/obstacle_alarm"]
    said = Messages().decode("std_msgs/String", alarms[0].data).data
    assert said.startswith("obstacle at 1.")
    assert said.endswith("told to drive at 1.000000 m/s")
    assert all(message.result != "dropped" for message in guarded.messages)
    assert guarded.farthest() > 20


@pytest.mark.parametrize("forward", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("start", [0.0, 0.4])
def test_no_speed_and_no_course_touches_the_obstacle(forward: float, start: float) -> None:
    mission = (
        Part(start / 0.4 if start else 0.1, turn=0.1 if start else 0.0),
        Part(30 / forward / 2, forward=forward),
    )
    guarded = Simulation(specification("obstacle_avoidance")).run(mission)
    assert guarded.nearest(OBSTACLE) > 0.3
    assert Simulation().run(mission).nearest(OBSTACLE) < 0


def test_a_blind_laser_is_an_obstacle() -> None:
    simulation = Simulation(specification("obstacle_avoidance"))
    simulation.laser_works = False
    simulation.run((Part(3.0, forward=1.0),))
    assert simulation.drive.poses[-1].x == 0
    simulation.laser_works = True
    simulation.run((Part(1.0), Part(2.0, forward=1.0)))
    reached = simulation.drive.poses[-1].x
    assert reached > 1
    simulation.laser_works = False
    simulation.run((Part(5.0, forward=1.0),))
    assert simulation.drive.poses[-1].x < reached + 1.5


def test_all_monitors_together(unguarded: Drive) -> None:
    guarded = Simulation(SHIPPED).run()
    assert guarded.nearest(OBSTACLE) > 0.3
    assert guarded.farthest() < 20 + SLACK
    assert [shot.fired for shot in guarded.shots] == [True, False, True]
    assert {"trigger 1"} == {text for _time, text in guarded.log if text.startswith("trigger")}
    assert len([one for one in guarded.messages if one.topic == TRIGGERED]) == len(unguarded.shots)
    assert sum(part.fire for part in MISSION) == 3


def test_a_recording_gives_the_same_verdicts_as_the_drive(
    bag: Path, unguarded: Drive, tmp_path: Path
) -> None:
    output = tmp_path / "guarded.bag"
    records = replayed(bag, *SHIPPED, output=output)
    messages = [one for one in records if "topic" in one]
    assert [message["topic"] for message in messages] == [message.topic for message in unguarded.messages]
    shots = [message["outcome"] for message in messages if message["topic"] == TRIGGERED]
    assert shots == ["passed", "dropped", "passed"]
    outcomes = {
        topic: {message["outcome"] for message in messages if message["topic"] == topic}
        for topic in (VELOCITY, "/landshark/odom")
    }
    assert outcomes == {VELOCITY: {"passed", "changed", "dropped"}, "/landshark/odom": {"passed"}}
    alarms = [message for message in messages if message["published"]]
    assert {alarm["published"][0]["topic"] for alarm in alarms} == {"/landshark/obstacle_alarm"}
    assert not [one for one in records if one["faults"]]
    again = replayed(output, *specification("safe_triggering"))
    assert [one["outcome"] for one in again if one["topic"] == TRIGGERED] == ["passed", "passed"]


def test_a_recording_gives_the_same_records_every_time(bag: Path) -> None:
    assert replayed(bag, *SHIPPED) == replayed(bag, *SHIPPED)


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    need_ros()
    options = ("--monitors", str(MONITORS), "--api", "off")
    with Appliance(policy=OPEN_POLICY, options=options) as appliance:
        yield appliance


@pytest.fixture(scope="module")
def robot(appliance: Appliance, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSession]:
    with RosSession(appliance.master_uri, tmp_path_factory.mktemp("robot")) as session:
        for program in (["base.py"], ["turret.py"], ["sensors.py", "gps"], ["sensors.py", "laser"]):
            session.start([PYTHON, str(NODES / program[0]), *program[1:]], label=program[-1])
        yield session


def told(robot: RosSession, *command: str) -> Record:
    said = robot.run(PYTHON, str(NODES / "command.py"), *command, timeout=120).stdout
    answer: Record = json.loads(said.splitlines()[-1])
    return answer


def fires(robot: RosSession, shots: int) -> None:
    def reported() -> int:
        said = robot.run("/usr/bin/rostopic", "echo", "-n", "1", "/landshark/shots").stdout
        return int(said.split()[1])

    if told(robot, "fire")["shots"] != shots:  # the driver was not connected to the node within a second
        eventually(lambda: reported() == shots, robot.story)


def test_the_running_robot_shoots_only_in_a_safe_pose(appliance: Appliance, robot: RosSession) -> None:
    for tilt, shots in ((0.2, 1), (-0.7, 1), (0.3, 2)):
        assert told(robot, "aim", "0", str(tilt))["tilt"] == pytest.approx(tilt, abs=0.02)
        fires(robot, shots)
    [dropped] = appliance.recorded("--event", "message dropped", resource=TRIGGERED)
    assert (dropped["caller_id"], dropped["host"]) == ("/ocu", "127.0.0.1")
    assert "safeTrigger" in json.dumps(dropped)


def test_the_running_robot_stops_before_the_obstacle(appliance: Appliance, robot: RosSession) -> None:
    alarm = robot.start(["/usr/bin/rostopic", "echo", "-n", "1", "/landshark/obstacle_alarm"])
    there = told(robot, "drive", "2.0", "0", "5")
    assert 3 < there["x"] < 6.9
    alarm.wait_for_text("obstacle at")
    again = told(robot, "drive", "2.0", "0", "1")
    assert again["x"] < 6.9
    back = told(robot, "drive", "-1.0", "0", "1")
    assert back["x"] < again["x"]
    assert appliance.recorded("--event", "message changed", resource=VELOCITY)


def test_a_verdict_is_a_record(appliance: Appliance, robot: RosSession, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "monitors-tutorial.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```cpp\n(gunPose\(.*?)```", page, re.DOTALL)
    (tmp_path / "gun.rv").write_text(text)
    appliance.rosrv("monitor", "load", str(tmp_path / "gun.rv"), "--msg", str(MONITORS / "msg"))
    told(robot, "aim", "0", "-0.7")
    shots = told(robot, "fire")["before"]
    fires(robot, shots)
    told(robot, "aim", "0", "0.3")
    fires(robot, shots)
    verdicts = appliance.recorded("--event", "monitor verdict", count=3)
    assert [verdict["detail"]["category"] for verdict in reversed(verdicts)] == ["warned", "locked", "locked"]
    appliance.rosrv("monitor", "remove", "gun.rv")
    fires(robot, shots + 1)
