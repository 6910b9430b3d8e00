"""A robot of real rospy nodes behind guards in a deployed appliance, and the acts that guards have to survive.

`rows` has what honest nodes send on the topics of each preset: the largest messages of real robots, at real rates.
`ACTS` is what happens to a guard in the life of a robot. After each act the robot moves again, nothing has faulted, and
a node that listens to the topics that a guard observes has got all of their messages.
"""

import contextlib
import json
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

from rosbags.typesys import get_types_from_msg

from appliance.channel import admin
from appliance.channel.admin import A, AdminRequest
from appliance.features.guards.presets import PRESETS, Guard, Preset, preset_of, text_of, topics_in
from appliance.features.guards.requests import GuardSet
from rosmop.tests.acting import STORE, message
from tests.support.appliance import Appliance
from tests.support.features.guards.running_guard import DEFINITIONS, named
from tests.support.nodes import RosSession
from tests.support.processes import Event, Process
from tests.support.waiting import eventually

RAYS = (180, 360, 720, 1080, 1650)
"""Numbers that scanners in use have."""
JOINTS = [f"joint_{number}" for number in range(7)]
POINTS = 50
GARBAGE = (b"\xff" * 7).hex()
SILENCE = 3.5
"""Seconds: longer than each preset permits by default."""
ARRIVAL = 2.0
"""Seconds after which a message counts as lost."""
LONGEST = 10.0
"""Seconds after which a base counts as one that stands for ever."""
PATIENCE = float(os.environ.get("TESTS_PATIENCE", "1"))


@dataclass(frozen=True)
class Stream:
    """The messages that a node sends in turn, so often a second."""

    kind: str
    hertz: float
    frames: Sequence[bytes]

    def on(self, topic: str) -> Mapping[str, object]:
        definition = {"md5sum": DEFINITIONS.md5sum(self.kind), "text": DEFINITIONS.full_text(self.kind)}
        frames = [frame.hex() for frame in self.frames]
        return {"topic": topic, "kind": self.kind, "hertz": self.hertz, "frames": frames, **definition}


def stream(kind: str, hertz: float, *fields: Mapping[str, object]) -> Stream:
    known = get_types_from_msg(DEFINITIONS.full_text(kind), kind.replace("/", "/msg/"))
    STORE.register({name: types for name, types in known.items() if name not in STORE.fielddefs})
    return Stream(kind, hertz, [message(kind, **one) for one in fields])


def scans(rays: int) -> Stream:
    """Return scans of a round scanner with noise, in a room of 10 m."""
    shape = {
        "angle_min": -math.pi,
        "angle_increment": 2 * math.pi / rays,
        "range_min": 0.1,
        "range_max": 30.0,
    }
    noise = [[5 + (ray * 7 + turn * 3) % 11 / 100 for ray in range(rays)] for turn in range(7)]
    hertz = 40 if rays <= 1080 else 25
    return stream("sensor_msgs/LaserScan", hertz, *({**shape, "ranges": ranges} for ranges in noise))


def path(**more: object) -> dict[str, object]:
    points = [
        {
            "positions": [0.01 * number] * len(JOINTS),
            "velocities": [0.1] * len(JOINTS),
            "accelerations": [0.0] * len(JOINTS),
            "time_from_start": {"sec": number // 10, "nanosec": number % 10 * 10**8},
        }
        for number in range(POINTS)
    ]
    return {"joint_names": JOINTS, "points": points, **more}


VELOCITY = stream("geometry_msgs/Twist", 20, *2 * ({},), *4 * ({"linear__x": 0.4},))
"""Motions after a stand of 0.1 s, as a person drives who is stopped: guards ask for a zero before a motion."""
TRAJECTORY = stream("trajectory_msgs/JointTrajectory", 10, path())
GOAL = stream(
    "control_msgs/FollowJointTrajectoryActionGoal", 10,
    *({"goal_id__id": f"goal-{number}", "goal__trajectory": path()} for number in range(10)),
)  # fmt: skip
RESULT = stream(
    "control_msgs/FollowJointTrajectoryActionResult", 10,
    *({"status__goal_id__id": f"goal-{number}", "status__status": 3} for number in range(10)),
)  # fmt: skip
IMAGE = stream("sensor_msgs/Image", 15, {"height": 240, "width": 320, "step": 960, "data": [7] * 230_400})
CLOUD = stream(
    "sensor_msgs/PointCloud2", 10, {"height": 16, "width": 1800, "point_step": 16, "data": [7] * 460_800}
)
ODOMETRY = stream("nav_msgs/Odometry", 50, {"pose__pose__orientation__w": 1.0})
JOINT_STATE = stream(
    "sensor_msgs/JointState", 50, {"name": [*JOINTS, "left", "right"], "position": [0.0] * 9}
)
BATTERY = stream("sensor_msgs/BatteryState", 5, {"percentage": 0.8})
FIX = stream("sensor_msgs/NavSatFix", 5, {"latitude": 48.0, "longitude": 11.0})
OFF = stream("std_msgs/Bool", 10, {})
ON = stream("std_msgs/Bool", 10, {"data": True})
DIAGNOSTICS = stream(
    "diagnostic_msgs/DiagnosticArray", 5,
    {"status": [
        {"name": f"/Robot/Sensors/part {part}: Status", "message": "it works", "hardware_id": f"0815-{part}",
         "values": [{"key": f"measured value {number}", "value": "17.25"} for number in range(20)]}
        for part in range(60)
    ]},
)  # fmt: skip
HELD = stream("std_msgs/Bool", 20, {}, *11 * ({"data": True},))
"""An enabling device that is let go at times: it has to be, before it counts as held."""
PRESSED = stream("std_msgs/Bool", 10, *2 * ({},), *2 * ({"data": True},))


@dataclass(frozen=True)
class Row:
    """The streams by the preset's names of the topics: one node sends on `command`, and another on the others."""

    preset: str
    streams: Mapping[str, Stream]
    values: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return "-".join([self.preset, *(one.kind.partition("/")[2] for one in self.streams.values())])

    @property
    def monitor(self) -> str:
        return f"own_{self.preset}"  # the appliance itself removes a monitor that is named `driver_check`

    def guard(self, preset: Preset | None = None) -> str:
        """Return the text of the guard, of another version of its preset if one is given."""
        preset = preset or named(self.preset)
        types = {name: one.kind for name, one in self.streams.items() if name in preset.topics}
        return text_of(Guard(self.monitor, preset, types=types, values=self.values))


def rows(rays: int = RAYS[-1]) -> list[Row]:
    scan = scans(rays)
    return [
        Row("agree", {"command": VELOCITY, "by": ODOMETRY, "other": ODOMETRY}),
        Row("answer", {"command": GOAL, "by": RESULT}),
        Row("ready", {"command": VELOCITY, "by": BATTERY, "fix": FIX, "check": ON},
            {"needFix": "true", "needCheck": "true"}),
        Row("deadman", {"command": VELOCITY}),
        Row("diagnostics", {"command": VELOCITY, "by": DIAGNOSTICS}),
        Row("driver_check", {"command": VELOCITY, "by": ODOMETRY}),
        Row("hold_to_run", {"command": VELOCITY, "by": HELD}),
        Row("estop", {"command": VELOCITY, "stop": OFF, "reset": PRESSED}),
        Row("estop", {"command": TRAJECTORY, "stop": OFF, "reset": PRESSED}),
        Row("fence", {"command": VELOCITY, "by": ODOMETRY}),
        Row("joints", {"command": TRAJECTORY, "state": JOINT_STATE}),
        Row("joints", {"command": GOAL, "state": JOINT_STATE}),
        Row("mode", {"command": VELOCITY, "by": OFF}),
        Row("overspeed", {"command": VELOCITY, "by": ODOMETRY}),
        Row("rate", {"command": VELOCITY}),
        Row("sane", {"command": VELOCITY}),
        Row("sensor", {"command": VELOCITY, "by": scan}),
        Row("sensor", {"command": TRAJECTORY, "by": CLOUD}),
        Row("separation", {"command": VELOCITY, "by": scan}),
        Row("speed", {"command": VELOCITY}),
        Row("standstill", {"command": VELOCITY, "by": ODOMETRY}),
        Row("withhold", {"command": IMAGE, "by": OFF}),
        Row("withhold", {"command": CLOUD, "by": OFF}),
        Row("zone", {"command": VELOCITY, "by": scan, "mute": OFF}),
    ]  # fmt: skip


WAIT = {"ready", "joints", "withhold"}
"""Presets that wait for a node that has ended until they begin again, `arm` for as long as a check counts."""


class GuardedRobot:
    """The nodes of a robot behind guards: `/driver` sends on the guarded topic, `/sensors` on what the guards observe.

    `/base` moves, and listens to all that is observed, as a navigation does.
    """

    def __init__(self, appliance: Appliance, ros: RosSession, guards: Sequence[tuple[Row, str]]) -> None:
        self.appliance, self.ros = appliance, ros
        self.texts = {row.monitor: text for row, text in guards}
        self.presets = {row.monitor: preset_of(text) or named(row.preset) for row, text in guards}
        streams = {
            (name == "command", topic): row.streams[name]
            for row, text in guards
            for name, topic in topics_in(text).items()
            if name in row.streams
        }
        self.streams = {
            sender: [
                one.on(topic)
                for (commands, topic), one in streams.items()
                if commands == (sender == "driver")
            ]
            for sender in ("driver", "sensors")
        }
        self.forgotten = self._mark = 0
        self._missing = Counter[str]()

    def __enter__(self) -> Self:
        self.load()
        self.appliance.ignore_earlier_records()
        topics = [str(one["topic"]) for sender in self.streams.values() for one in sender]
        self.base = self.ros.node("rospy", "frame_listener", topics[0], "/sensors", *topics[1:], name="base")
        self.driver, self.sensors = (self.talker(name, name) for name in self.streams)
        return self

    def __exit__(self, *exc: object) -> None:
        try:
            self.ros.__exit__(*exc)
        finally:  # the next test has the same appliance
            self.ask(admin.MonitorRemove(list(self.texts)))

    def load(self) -> None:
        self.ask(admin.MonitorLoad({f"{name}.rv": text for name, text in self.texts.items()}, hold=True))

    def resume(self) -> None:
        """Resume the guards that hold the guarded topic until an operator does so."""
        if held := [monitor.name for monitor in self.ask(admin.MonitorsWanted()).monitors if monitor.held]:
            self.ask(admin.MonitorResume(held))

    def talker(self, name: str, sender: str) -> Process:
        node = self.ros.node("rospy", "frame_talker", name=name)
        node.send(json.dumps(self.streams[sender]))
        return node

    def order(self, what: str, **more: str) -> None:
        for talker in (self.driver, self.sensors):
            talker.send(json.dumps({"do": what, **more}))

    def ask(self, request: AdminRequest[A]) -> A:
        return self.appliance.ask(request)

    def moves(self, since: float) -> float:
        """Wait until the base moves, and return the seconds from the moment `since`; infinity after a long time."""
        moved: Event = {"at": math.inf}
        with contextlib.suppress(AssertionError):
            moved = self.base.wait_for(
                lambda one: one.get("at", 0) > since, since=self._mark, timeout=LONGEST
            )
        self._mark = self.base.mark()
        return float(moved["at"]) - since

    def lost(self) -> Counter[str]:
        """Return how many observed messages the base has not got since the last call, by topic."""
        mark = self.sensors.mark()
        self.sensors.send(json.dumps({"do": "pause"}))
        sent: Counter[str] = Counter(self.sensors.wait_for(event="paused", since=mark)["sent"])
        missing = Counter[str]()

        def all_came() -> bool:
            mark = self.base.mark()
            self.base.send("")
            missing.clear()
            missing.update(sent - Counter(self.base.wait_for(event="counted", since=mark)["heard"]))
            return missing <= self._missing

        with contextlib.suppress(AssertionError):
            eventually(all_came, "", ARRIVAL)
        lost, self._missing = missing - self._missing, missing
        self.sensors.send(json.dumps({"do": "resume"}))
        return lost

    def faults(self) -> list[str]:
        """Return the faults of monitors, but for those that bytes cause that are not a message."""
        reasons = [one["reason"] for one in self.appliance.audit(event="monitor fault")]
        self.appliance.ignore_earlier_records()
        return [reason for reason in reasons if "the bytes are not a message" not in reason]

    def judged(self) -> bool:
        """Return whether each guard is in force and has got messages since its relay started."""
        return all(one.enabled and one.events for one in self.ask(admin.MonitorsWanted()).monitors)

    def after(self, act: "Act") -> "Passage":
        """Return what became of the robot after the act."""
        act.happens(self)
        seconds = self.moves(time.monotonic())
        lost = self.lost()
        return Passage(act, seconds, lost, self.faults(), again=self.moves(time.monotonic()))


@dataclass(frozen=True)
class Act:
    happens: Callable[[GuardedRobot], None]
    within: float = 1.0
    """The seconds after which the base moves again."""
    cuts: bool = False
    """It ends connections, so messages are lost."""

    @property
    def name(self) -> str:
        return self.happens.__name__


@dataclass(frozen=True)
class Passage:
    act: Act
    seconds: float
    lost: Mapping[str, int]
    faults: Sequence[str]
    again: float
    """The seconds until the base moved after the sensors were silent once more."""

    def __str__(self) -> str:
        lost = ", ".join(f"{count} of {topic} lost" for topic, count in self.lost.items())
        words = [
            f"moves after {self.seconds:.2f} s",
            lost,
            f"{len(self.faults)} faults" if self.faults else "",
        ]
        return f"{self.act.name}: {', '.join(filter(None, words))}{'' if self.holds else '  BROKEN'}"

    @property
    def holds(self) -> bool:
        late = max(self.seconds, self.again) > PATIENCE * self.act.within
        return not late and not self.faults and (self.act.cuts or not self.lost)


def load(robot: GuardedRobot) -> None:
    robot.ask(admin.MonitorRemove(list(robot.texts)))
    robot.load()
    robot.resume()


def reload(robot: GuardedRobot) -> None:
    """Load the guards with a further remark."""
    robot.texts |= {name: f"{text}//\n" for name, text in robot.texts.items()}
    robot.load()
    robot.resume()


def resume(robot: GuardedRobot) -> None:
    robot.ask(admin.MonitorResume(list(robot.texts)))


def disable(robot: GuardedRobot) -> None:
    for enabled in (False, True):
        robot.ask(admin.MonitorSwitch(list(robot.texts), enabled))


def shadow(robot: GuardedRobot) -> None:
    for only in (True, False):
        robot.ask(admin.MonitorShadow(list(robot.texts), only, force=True))


def set_value(robot: GuardedRobot) -> None:
    """Set the first parameter of each guard, to the value that it has."""
    for name, preset in robot.presets.items():
        for parameter in preset.parameters[:1] if preset.name in PRESETS else ():
            robot.ask(GuardSet(name, {parameter.name: parameter.default}, hold=True))


def malformed(robot: GuardedRobot) -> None:
    robot.order("say", hex=GARBAGE)
    threading.Event().wait(0.2)
    robot.resume()


def silence(robot: GuardedRobot) -> None:
    robot.order("pause")
    threading.Event().wait(SILENCE)
    robot.order("resume")


def another_node(robot: GuardedRobot) -> None:
    """Let other nodes send on all topics and end. Guards with `forget` forget them, and those in `WAIT` begin again."""
    guests = [robot.talker(f"other_{sender}", sender) for sender in robot.streams]
    threading.Event().wait(0.5)
    for guest in guests:
        guest.stop()
        robot.ros.processes.remove(guest)
    robot.forgotten += 1
    for name, preset in robot.presets.items():
        if "forget" in {parameter.name for parameter in preset.parameters}:
            robot.ask(GuardSet(name, {"forget": str(robot.forgotten)}))
        elif preset.name in WAIT:
            load(robot)


def kill_sensors(robot: GuardedRobot) -> None:
    """Let another process take the place of the node that sends on the sources, under its name."""
    robot.sensors.kill()
    robot.sensors.stop()
    robot.ros.processes.remove(robot.sensors)
    robot.sensors = robot.talker("sensors", "sensors")


def kill_relay(robot: GuardedRobot) -> None:
    _kill(robot, "relay")


def kill_control(robot: GuardedRobot) -> None:
    _kill(robot, "control")


def _kill(robot: GuardedRobot, role: str) -> None:
    killed = robot.appliance.kill(role)
    eventually(lambda: set(robot.appliance.pids(role)) - {killed}, f"{role} runs again")


def restart(robot: GuardedRobot) -> None:
    robot.appliance.stop()
    robot.appliance.start()


# Another node counts for a second after its end. rospy connects again after 0.5 s, and then after another second.
ACTS = (
    Act(load), Act(reload), Act(resume), Act(disable), Act(shadow), Act(set_value), Act(malformed), Act(silence),
    Act(another_node, within=2.0), Act(kill_relay, within=3.0, cuts=True),
    Act(kill_control), Act(restart, within=2.0, cuts=True), Act(kill_sensors, cuts=True)
)  # fmt: skip
