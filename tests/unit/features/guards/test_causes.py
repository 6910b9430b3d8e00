"""The cause of each stop of each preset is a true sentence: condition, value, limit, node and host.

Each `STOP` of a preset's text has to be reached here, so one without a sentence fails.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from appliance.api.routes.contract import EXAMPLES
from appliance.base import clock
from appliance.channel.messages import MonitorEvent, MonitorsReported
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.relay.monitors.observation_points import ObservationPoint, ObservedMessage
from rosmop.form import nodes
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Fault, MessageSender, Outcome
from rosmop.tests.acting import message
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

APART = {
    "answer": "it cancels goals, and has no stop",
    "rate": "it drops commands, and has no stop",
    "withhold": "it withholds a topic, and has no stop",
}
HOSTS = {
    "/teleop": "10.0.0.7",
    "/nav": "10.0.0.8",
    "/third": "10.0.0.9",
    "/lidar": "10.0.0.3",
    "/other": "10.0.0.4",
}
TELEOP, LIDAR, OTHER = (f"{node} of {HOSTS[node]}" for node in ("/teleop", "/lidar", "/other"))
FALSE = re.compile(r"\w+ = |\b(nan|inf|-inf)\b|, or | is not known")
"""No sentence has these: a dump of variables, numbers that are none, a list of suspects."""

KINDS = {
    "sensor": "sensor_msgs/LaserScan", "separation": "sensor_msgs/LaserScan", "zone": "sensor_msgs/LaserScan",
    "diagnostics": "diagnostic_msgs/DiagnosticArray",
    "ready": "sensor_msgs/BatteryState", "hold_to_run": "std_msgs/Bool", "mode": "std_msgs/Bool",
}  # fmt: skip
"""The type of `by`, if it is not odometry."""
OTHERS = {"fix": "sensor_msgs/NavSatFix", "other": "nav_msgs/Odometry"}
"""The types of further topics, if they are not `std_msgs/Bool`."""


class Robot:
    """A guarded robot. `causes` are those that its relay reported since they were last taken, of stops only."""

    def __init__(self, preset: str, time: VirtualClock, **values: object) -> None:
        self.preset, self._time = preset, time
        self.quiet = QuietMonitors()
        given = {name: str(value).lower() for name, value in values.items()}
        text = text_of(Guard("guard", PRESETS[preset], values=given))
        self._lines = text.count("\n")
        self.quiet.load(text)
        self.interceptor = self.quiet.interceptor
        self.topics = PRESETS[preset].given_topics
        self.events: list[MonitorEvent] = []

    def say(self, given: str, node: str, **fields: object) -> None:
        by = KINDS.get(self.preset, "nav_msgs/Odometry")
        kind = by if given == "by" else OTHERS.get(given, "std_msgs/Bool")
        self.send(given, node, message("geometry_msgs/Twist" if given == "command" else kind, **fields))

    def send(self, given: str, node: str, data: bytes) -> None:
        point = ObservationPoint("key", self.topics[given], HOSTS[node], node)
        interceptor, monitors = self.interceptor, monitors_of(self)
        sender = MessageSender(interceptor.senders.number(point))
        outcome = monitors.process(point.resource, bytearray(data), interceptor.now(), sender)
        interceptor.observer.report(outcome, point)
        if outcome.result == "changed":
            interceptor.observer.changed(outcome, point, data, len(data), ObservedMessage(None, 0, b""))

    def drive(self, v: float = 0.2, node: str = "/teleop", **more: object) -> None:
        self.say("command", node, linear__x=v, **more)

    def wait(self, seconds: float) -> None:
        """Let time pass; a relay reports each second."""
        for _ in range(round(seconds * 100)):
            self._time.advance(0.01)
            for outcome in monitors_of(self).advance(self.interceptor.now()):
                self.interceptor.observer.report(outcome, ObservationPoint("", ""))
        self.collect()

    def collect(self) -> None:
        self.interceptor.tick()
        self.interceptor.observations.flush()
        for one in self.quiet.reports.sent:
            self.events += (
                [] if not isinstance(one, MonitorsReported) else [event for event in one.events if event.safe]
            )
        self.quiet.reports.sent.clear()

    def cause(self) -> str:
        """Return the last cause."""
        self.collect()
        found = [str(event.detail["cause"]) for event in self.events if "cause" in event.detail]
        return found[-1] if found else ""

    def reached(self) -> set[tuple[int, str]]:
        self.collect()
        return {self.place(at) for event in self.events for at in event.detail.get("at", ())}

    def place(self, position: str) -> tuple[int, str]:
        """Return the lines behind a place, and its column: the values in the text are before it."""
        _file, line, column = position.split(":")
        return self._lines - int(line), column

    def keep(self, seconds: float, *steps: "Step") -> None:
        """Do something every 50 ms."""
        for _ in range(round(seconds * 20)):
            then(*steps)(self)
            self.wait(0.05)


Step = Callable[[Robot], None]
Case = tuple[Mapping[str, object], Step, str]


def scan(robot: Robot, r: float = 9.0, node: str = "/lidar", **more: Any) -> None:
    step = math.pi / 180
    limits = {"angle_min": -math.pi, "angle_increment": step, "range_min": 0.1, "range_max": 30.0}
    ranges = [r + 0.001 * ((ray * 7 + int(clock.now() * 100)) % 11) for ray in range(360)]
    robot.say("by", node, **{**limits, "ranges": ranges, **more})


def odometry(
    robot: Robot, x: float = 0.0, v: float = 0.0, *, given: str = "by", node: str = "/lidar", w: float = 1.0
) -> None:
    robot.say(given, node, pose__pose__position__x=x, pose__pose__orientation__w=w, twist__twist__linear__x=v)


def then(*steps: Step) -> Step:
    def run(robot: Robot) -> None:
        for step in steps:
            step(robot)

    return run


def drive(v: float = 0.2, node: str = "/teleop", **more: object) -> Step:
    return lambda robot: robot.drive(v, node, **more)


def keep(seconds: float, *steps: Step) -> Step:
    return lambda robot: robot.keep(seconds, *steps)


def driven(*see: Step) -> Step:
    """Let the robot stand and then move, with what the guard wants to see."""
    return then(keep(0.3, *see, drive(0)), keep(0.6, *see, drive()))


def silent(seconds: float = 0.7) -> Step:
    """Let the evidence be silent while the robot is commanded to move."""
    return keep(seconds, drive())


def waits(seconds: float) -> Step:
    return lambda robot: robot.wait(seconds)


def sees(see: Step, seconds: float = 0.4) -> Step:
    return keep(seconds, see, drive())


def scans(r: float = 9.0, node: str = "/lidar", **more: Any) -> Step:
    return lambda robot: scan(robot, r, node, **more)


def wall(r: float) -> Step:
    return scans(ranges=[r] * 360)


def at(x: float, v: float = 0.0, w: float = 1.0) -> Step:
    return lambda robot: odometry(robot, x, v, w=w)


def other(v: float = 0.0, node: str = "/other", given: str = "by") -> Step:
    return lambda robot: odometry(robot, v=v, given=given, node=node)


def both(v: float = 0.0, theirs: float = 0.0) -> Step:
    return then(other(theirs, given="other"), at(0, v))


def say(given: str, node: str = "/lidar", **fields: object) -> Step:
    return lambda robot: robot.say(given, node, **fields)


def bool_of(data: bool, given: str = "by", node: str = "/lidar") -> Step:
    return say(given, node, data=data)


def statuses(*levels: int, name: str = "motor", node: str = "/lidar") -> Step:
    """Send an entry with each level; their names differ if there are several."""
    rows = [{"name": f"{name}{number or ''}", "level": level} for number, level in enumerate(levels)]
    return say("by", node, status=rows)


def battery(left: float = 0.8, *, fix: int = 0, lat: float = 48.0, check: bool = True) -> Step:
    def see(robot: Robot) -> None:
        robot.say("by", "/lidar", percentage=left)
        robot.say("fix", "/other", status__status=fix, latitude=lat, longitude=11.0)
        robot.say("check", "/nav", data=check)

    return see


def moment(seconds: float) -> dict[str, int]:
    return {"sec": int(seconds), "nanosec": round(seconds % 1 * 1e9)}


def elbow(position: float = 0.0, node: str = "/lidar", name: str = "elbow", late: float = 0.0) -> Step:
    def see(robot: Robot) -> None:
        stamp = moment(clock.now() - late)
        fields = {"header__stamp": stamp, "name": [name], "position": [position]}
        robot.send("state", node, message("sensor_msgs/JointState", **fields))

    return see


def go(*points: tuple[float, float], names: tuple[str, ...] = ("elbow",), begin: float | None = None) -> Step:
    """Command points, each at seconds and at the same rad for all joints; it begins in `begin` seconds."""

    def command(robot: Robot) -> None:
        rows = [
            {"positions": [position] * len(names), "time_from_start": moment(at)} for at, position in points
        ]
        stamp = moment(0 if begin is None else clock.now() + begin)
        fields = {"header__stamp": stamp, "joint_names": list(names), "points": rows}
        robot.send("command", "/teleop", message("trajectory_msgs/JointTrajectory", **fields))

    return command


def nine(given: str, **fields: object) -> Step:
    def see(robot: Robot) -> None:
        for number in range(9):
            HOSTS.setdefault(f"/n{number}", "10.0.1.1")
            robot.say(given, f"/n{number}", **fields)

    return see


def pressed(robot: Robot) -> None:
    robot.say("stop", "/lidar", data=True)
    robot.wait(0.01)


def held(robot: Robot) -> None:
    then(bool_of(False), driven(bool_of(True)))(robot)


def crossed(robot: Robot) -> None:
    """Drive once the zone is free."""
    sees(scan, 1)(robot)
    robot.drive(0)
    sees(scan, 0.2)(robot)


ONCE = waits(0.01)
NONE_YET = "no message on {} since the guard began"
SILENT = f"no message from {LIDAR} on {{}} for {{}} s (limit {{}} s)"
INTRUDER = f"{OTHER} also publishes on {{}}, last 0.00 s ago (limit 1 s)"
NOT_FINITE = f"{TELEOP} commands a velocity that is not a finite number"
ZERO_FIRST = f"{TELEOP} must command zero before its motion passes"
STAND_FIRST = (
    f"the base stands, as {LIDAR} measures it on /odom, and a command to stand must come before a motion"
)
NOT_VALID = f"0 of 360 values from {LIDAR} on /scan are valid (at least one and 10 % must be)"
SCAN, ODOM, DIAGNOSTICS, JOINTS = "/scan", "/odom", "/diagnostics", "/joint_states"
STANDS, FIX = {"vMax": 0, "wMax": 0}, {"needFix": True}
CASES: dict[str, list[Case]] = {
    "sane": [
        ({}, drive(math.nan), f"the linear velocity that {TELEOP} commands is not a finite number"),
        ({}, drive(0, angular__z=math.inf), f"the angular velocity that {TELEOP} commands is not a finite number"),
    ],
    "speed": [
        ({}, drive(math.nan), NOT_FINITE),
        ({"vMax": 0}, drive(0.5),
         f"{TELEOP} commands 0.50 m/s and 0.00 rad/s, which may not grow from zero within 0.100 s"
         " (limits 0 m/s and 1 rad/s)"),
    ],
    "sensor": [
        ({}, silent(), NONE_YET.format(SCAN)),
        ({}, then(driven(scan), waits(0.6)), SILENT.format(SCAN, "0.51", "0.5")),
        ({}, then(driven(scan), silent(2)), SILENT.format(SCAN, "1.55", "0.5")),
        ({}, then(driven(scan), scans(node="/other"), sees(scan, 0.05)), INTRUDER.format(SCAN)),
        ({"frozen": 3}, sees(scans(ranges=[1.0] * 360), 2),
         f"{LIDAR} repeated its values on /scan 23 times (limit 3)"),
        ({}, sees(wall(99.0)), NOT_VALID),
    ],
    "overspeed": [
        ({}, silent(), NONE_YET.format(ODOM)),
        ({}, sees(at(0)), STAND_FIRST),
        ({}, then(driven(at(0, 0.2)), at(0, 0.9)),
         "the base moves with 0.90 m/s and 0.00 rad/s (limits 0.6 m/s and 1.2 rad/s),"
         f" as {LIDAR} measures it on /odom"),
        ({}, at(0, math.nan), f"{LIDAR} measures a velocity on /odom that is not a finite number"),
        ({}, sees(at(0, 0.3)),
         "the base still moves with 0.30 m/s and 0.00 rad/s (it stands at 0.05 m/s and rad/s),"
         f" as {LIDAR} measures it on /odom"),
        ({}, then(driven(at(0)), waits(0.6)), SILENT.format(ODOM, "0.51", "0.5")),
        ({}, then(driven(at(0)), other(), waits(0.1)), INTRUDER.format(ODOM).replace("0.00", "0.02")),
    ],
    "standstill": [
        ({}, silent(), NONE_YET.format(ODOM)),
        ({}, sees(at(0)), STAND_FIRST),
        ({}, then(driven(at(0)), waits(0.6)), SILENT.format(ODOM, "0.51", "0.5")),
        ({}, then(driven(at(0)), keep(1.2, drive(0), at(0, 0.3))),
         "the base moves with 0.30 m/s and 0.00 rad/s"
         " (limit 0.05 m/s and rad/s) although no motion is commanded for 1.02 s (limit 1 s),"
         f" as {LIDAR} measures it on /odom"),
        ({}, then(driven(at(0)), drive(0), keep(1.2, at(0)), at(0, 0.3)),
         "the base moves with 0.30 m/s and 0.00 rad/s"
         " (limit 0.05 m/s and rad/s) although no motion is commanded for 1.20 s (limit 1 s),"
         f" as {LIDAR} measures it on /odom"),
        ({}, sees(at(0, 0.3)),
         "the base still moves with 0.30 m/s and 0.00 rad/s (it stands at 0.05 m/s and rad/s),"
         f" as {LIDAR} measures it on /odom"),
        ({}, sees(at(0, math.nan)), f"{LIDAR} measures a velocity on /odom that is not a finite number"),
    ],
    "agree": [
        ({}, silent(), NONE_YET.format(ODOM)),
        ({}, sees(at(0)), NONE_YET.format("/odom_other")),
        ({}, sees(both(), 0.1),
         f"the velocities from {LIDAR} on /odom and from {OTHER} on /odom_other agree in 1 messages in a row,"
         " of 5 that are needed"),
        ({}, sees(both(1.0)),
         f"the velocities from {LIDAR} on /odom and from {OTHER} on /odom_other differ by 1.00 m/s and 0.00 rad/s"
         " (limits 0.1 m/s and 0.2 rad/s)"),
        ({}, sees(both(math.nan)),
         f"a velocity from {LIDAR} on /odom, compared with that from {OTHER} on /odom_other, is not a finite number"),
        ({}, then(driven(both()), waits(0.6)), SILENT.format(ODOM, "0.51", "0.5")),
        ({}, then(driven(both()), other(), waits(0.1)), INTRUDER.format(ODOM).replace("0.00", "0.02")),
    ],
    "ready": [
        ({}, silent(), NONE_YET.format("/battery_state")),
        ({}, sees(battery(0.1)), f"{LIDAR} reports a charge of 0.1 on /battery_state (limits 0.2 and 1)"),
        ({}, sees(battery(75)), f"{LIDAR} reports a charge of 75 on /battery_state (limits 0.2 and 1)"),
        ({}, sees(battery(math.nan)), f"{LIDAR} reports no charge on /battery_state"),
        (FIX, sees(battery(fix=-1)), f"{OTHER} reports no fix on /fix, with the status -1 (limits 0 and 2)"),
        (FIX, sees(battery(lat=95)), f"{OTHER} reports a position on /fix that is not on the earth: 95, 11 degrees"),
        (FIX, sees(battery(lat=math.nan)), f"{OTHER} reports a position on /fix that is not a finite number"),
        ({"needCheck": True}, sees(battery(check=False)),
         "/nav of 10.0.0.8 reports on /preflight that the check was not passed"),
        ({"silent": 0.5}, then(driven(battery()), waits(0.7)), SILENT.format("/battery_state", "0.55", "0.5")),
        ({"needCheck": True, "silent": 0.5}, sees(say("by", percentage=0.9)), NONE_YET.format("/preflight")),
    ],
    "deadman": [
        ({}, drive(), f"{TELEOP} commands for 0.00 s without a pause (a motion passes after 0.2 s)"),
        ({}, then(drive(), waits(0.4)),
         f"{TELEOP} commands for 0.00 s without a pause (a motion passes after 0.2 s)"),
        ({}, then(driven(), waits(0.38)),
         f"{TELEOP} commanded a motion on /cmd_vel, and nothing for 0.31 s since (limit 0.3 s)"),
        ({}, then(driven(), waits(2.1)),
         f"{TELEOP} commanded a motion on /cmd_vel, and nothing for 0.31 s since (limit 0.3 s)"),
        ({}, then(keep(0.6, drive(), drive(0.1, "/nav")), ONCE, drive(0.1, "/third")),
         f"/third of 10.0.0.9 commands a motion, and so do {TELEOP} and /nav of 10.0.0.8 (limit 2 nodes)"),
    ],
    "estop": [
        ({}, silent(0.2), "no button has sent a message on /emergency_stop"),
        ({"silent": 0}, silent(0.2), "no button has sent a message on /emergency_stop"),
        ({"publishers": 2}, sees(bool_of(False, "stop")), "1 of 2 buttons have sent a message on /emergency_stop"),
        ({}, pressed, f"{LIDAR} is pressed on /emergency_stop"),
        ({}, then(pressed, silent(0.2)), f"{LIDAR} is pressed on /emergency_stop"),
        ({}, then(pressed, keep(1.5, bool_of(False, "stop"))),
         "all buttons on /emergency_stop are released, and a reset by a node on /emergency_stop_reset is awaited"),
        ({"twoHands": True}, then(pressed, keep(1.5, bool_of(False, "stop"))),
         "all buttons on /emergency_stop are released, and a reset by two nodes on /emergency_stop_reset is awaited"),
        ({}, sees(bool_of(False, "stop")), ZERO_FIRST),
        ({}, then(driven(bool_of(False, "stop")), waits(1.2)), SILENT.format("/emergency_stop", "1.05", "1")),
        ({}, then(nine("stop", data=False), ONCE), "nine nodes publish on /emergency_stop (limit 8)"),
    ],
    "hold_to_run": [
        ({}, silent(0.2), "no enabling device has sent a message on /enable"),
        ({"publishers": 2}, held, "1 of 2 enabling devices have sent a message on /enable"),
        ({}, sees(bool_of(True)), f"{LIDAR} must be let go on /enable once before it counts as held"),
        ({}, then(held, bool_of(False)), f"{LIDAR} is let go on /enable"),
        ({}, then(held, waits(0.4)), SILENT.format("/enable", "0.31", "0.3")),
        ({}, then(bool_of(False), sees(bool_of(True))), ZERO_FIRST),
        ({}, then(held, nine("by", data=True), silent(0.1)), "nine nodes publish on /enable (limit 8)"),
    ],
    "mode": [
        (STANDS, silent(0.2), "no node says the mode on /manual, so it is manual (limits 0 m/s and 0 rad/s)"),
        (STANDS, sees(bool_of(True)), f"{LIDAR} says manual mode on /manual (limits 0 m/s and 0 rad/s)"),
        ({"vMax": 0.1}, then(driven(bool_of(False)), bool_of(True)),
         f"{LIDAR} says manual mode on /manual (limits 0.1 m/s and 0.5 rad/s)"),
        ({"vMax": 0.1}, then(driven(bool_of(False)), waits(1.1)),
         SILENT.format("/manual", "1.01", "1") + ", so the mode is manual (limits 0.1 m/s and 0.5 rad/s)"),
        (STANDS, sees(bool_of(False)),
         f"{TELEOP} commands 0.20 m/s and 0.00 rad/s, and has not been slow in automatic mode"
         " (limits 0 m/s and 0 rad/s)"),
        ({"vMax": 0, "wMax": 0, "publishers": 2}, sees(bool_of(False)),
         "1 of 2 nodes say the mode on /manual, so it is manual (limits 0 m/s and 0 rad/s)"),
        ({"vMax": 0.1}, drive(math.nan), NOT_FINITE),
        ({"vMax": 0.1}, then(driven(bool_of(False)), nine("by", data=False)),
         "nine nodes publish on /manual (limit 8), so the mode is manual (limits 0.1 m/s and 0.5 rad/s)"),
    ],
    "diagnostics": [
        ({}, silent(0.2), NONE_YET.format(DIAGNOSTICS)),
        ({}, sees(statuses()), "no entry on /diagnostics has come whose name begins with ''"),
        ({"named": "laser, hardware_id:7*"}, sees(statuses(0, name="laser")),
         "no entry on /diagnostics has come whose hardware_id begins with '7'"),
        ({}, sees(statuses(0)), ZERO_FIRST),
        ({}, then(driven(statuses(0)), statuses(2)), f"motor from {LIDAR} on /diagnostics is at level 2 (limit 1)"),
        ({"warnings": True}, sees(statuses(0, 1)), f"motor1 from {LIDAR} on /diagnostics is at level 1 (limit 0)"),
        ({"silent": 0.5}, then(driven(statuses(0)), waits(0.6)),
         f"no message with motor from {LIDAR} on /diagnostics for 0.51 s (limit 0.5 s)"),
        ({}, sees(statuses(*[0] * 65)),
         "more than 64 entries on /diagnostics have these names; set forget to another number"),
    ],
    "fence": [
        ({}, silent(0.2), NONE_YET.format(ODOM)),
        ({}, then(driven(at(0)), waits(0.6)), SILENT.format(ODOM, "0.51", "0.5")),
        ({}, sees(at(math.nan)), f"{LIDAR} reports a position on /odom that is not a finite number"),
        ({}, sees(at(0, w=0)), f"{LIDAR} reports a position on /odom without a direction"),
        ({}, sees(at(7)),
         f"the base is 5.00 m outside the fence, at 7.00 and 0.00 m by {LIDAR} on /odom,"
         " and its command does not lead straight back"),
        ({}, sees(at(1.9)),
         f"the base is 0.10 m from the fence (margin 0.2 m), at 1.90 and 0.00 m by {LIDAR} on /odom,"
         " and its command does not lead straight back"),
        ({}, then(driven(at(0)), at(1.75)),
         f"the base is 0.25 m from the fence, at 1.75 and 0.00 m by {LIDAR} on /odom,"
         " and could come nearer than 0.2 m with 0.20 m/s before the next position"),
        ({}, sees(then(at(0), drive(math.inf))), NOT_FINITE),
        ({}, then(driven(at(0)), other(), waits(0.1)), INTRUDER.format(ODOM).replace("0.00", "0.02")),
    ],
    "separation": [
        ({}, silent(0.2), NONE_YET.format(SCAN)),
        ({}, then(driven(scan), waits(0.6)), SILENT.format(SCAN, "0.51", "0.5")),
        ({}, sees(wall(0.6)),
         "0.45 m are known to be free in the way, and a motion needs more than 1.45 m,"
         f" by the scan from {LIDAR} on /scan"),
        ({}, sees(wall(math.nan)),
         "0.00 m are known to be free in the way, and a motion needs more than 1.45 m,"
         f" by the scan from {LIDAR} on /scan"),
        ({"sector": 1}, sees(then(scan, drive(-0.2))),
         f"the way of 0.20 m/s is outside the sector of the scanner, {LIDAR} on /scan (limit 0 m/s)"),
        ({}, then(driven(scan), wall(0.6), waits(0.1)),
         "0.45 m are known to be free in the way, and a motion needs more than 0.77 m,"
         f" by the scan from {LIDAR} on /scan"),
        ({}, drive(math.nan), NOT_FINITE),
        ({}, then(driven(scan), scans(node="/other"), waits(0.1)), INTRUDER.format(SCAN).replace("0.00", "0.02")),
    ],
    "zone": [
        ({}, silent(0.2), NONE_YET.format(SCAN)),
        ({}, then(crossed, waits(0.4)), SILENT.format(SCAN, "0.31", "0.3")),
        ({}, sees(wall(0.6)),
         f"83 rays from {LIDAR} on /scan end in the zone or before it, and 0 are not valid (limit 3)"),
        ({}, sees(scan), f"the zone is free for 0.00 s (limit 0.5 s), by the scans from {LIDAR} on /scan"),
        ({}, sees(scan, 1), ZERO_FIRST),
        ({}, sees(scans(angle_increment=0.0)), f"{LIDAR} sends scans on /scan whose angles or ranges are not valid"),
        ({}, sees(scans(angle_min=0.0, ranges=[9.0] * 9)), f"the rays from {LIDAR} on /scan do not cover the zone"),
        ({}, then(crossed, wall(0.6), waits(0.1)),
         f"83 rays from {LIDAR} on /scan end in the zone or before it, and 0 are not valid (limit 3)"),
        ({}, drive(math.nan), NOT_FINITE),
    ],
    "joints": [
        ({}, go((1, 0)), NONE_YET.format(JOINTS)),
        ({}, then(elbow(), waits(0.6), go((1, 0))), SILENT.format(JOINTS, "0.60", "0.5")),
        ({}, then(elbow(math.nan), go((1, 0))), f"{LIDAR} reports no finite position of elbow on {JOINTS}"),
        ({}, then(elbow(name="wrist"), go((1, 0))), f"{LIDAR} reports no finite position of elbow on {JOINTS}"),
        ({}, then(elbow(), elbow(math.nan, "/other"), go((1, 0))),
         f"{OTHER} reports no finite position of elbow on {JOINTS}"),
        ({}, then(elbow(), go((1, 0), names=())), f"a trajectory of {TELEOP} names no joint"),
        ({}, then(elbow(), elbow(node="/other", late=1), go((1, 0), begin=1)),
         f"a trajectory of {TELEOP} has a stamp, and the clocks of {LIDAR} and {OTHER},"
         " by the stamps of their reports, differ by 1.000 s (limit: 0.050 s)"),
        ({}, then(elbow(), elbow(node="/other"), elbow(node="/nav"), go((1, 0))),
         f"/nav of 10.0.0.8 reports positions, and so do {LIDAR} and {OTHER} (limit: two nodes)"),
        ({}, then(elbow(), go((1, 0), (1, 0.1))),
         f"point 2 of {TELEOP} is at 1.000 s, the one before at 1.000 s, with 1 positions, 0 velocities,"
         " 0 accelerations and 0 finite efforts for 1 joints"),
        ({}, then(elbow(), go((1, math.nan))),
         f"point 1 of {TELEOP} has elbow at a value that is not a finite number"),
        ({}, then(elbow(), go((1, 9))),
         f"point 1 of {TELEOP} has elbow at 9.000 rad, 0.000 rad/s, 0.000 rad/s2 (limits: -6.283 to 6.283 rad,"
         " 3.200 rad/s, 50.000 rad/s2)"),
        ({}, then(elbow(), go((1, 0), (1.1, 3))),
         f"elbow of {TELEOP} moves from 0.000 to 3.000 rad in 0.100 s to point 2, and does not keep its limits"
         " (-6.283 to 6.283 rad, 3.200 rad/s)"),
        ({}, then(elbow(), go((1, 0), begin=-5)),
         f"a trajectory of {TELEOP} that is over: its last point was 4.000 s ago (limit: 0.050 s from now)"),
        ({}, then(elbow(), go((1, 0), names=("elbow", "elbow"))),
         f"a trajectory of {TELEOP} has the joint elbow, which has no limits or is in it twice"),
        ({}, then(elbow(), go((1, 0), begin=1), elbow(), go((1, 0), begin=1)),
         f"a trajectory of {TELEOP} would wait, and one waits for 1.000 s (limit: one trajectory)"),
        ({}, then(elbow(), go((2, 0.1)), go((1, 0.1), begin=0.5)),
         f"a trajectory of {TELEOP} begins in 0.500 s (limit 0.100 s), while elbow moves for 2.000 s,"
         " and 0.200 s have to be between them"),
        ({}, then(elbow(), go((0.1, 1))),
         f"the way of elbow from 0.000 rad to point 1 of {TELEOP} at 1.000 rad in 0.100 s,"
         " at 0.000 to 0.000 rad/s now, may not keep its limits (a jump of 0.150 rad, -6.283 to 6.283 rad,"
         " 3.520 rad/s)"),
        ({}, then(elbow(), go((1, 0), begin=1), keep(1, elbow(0.1))),
         f"{LIDAR} does not report elbow on {JOINTS} within 0.075 rad (limit) of 0.000 rad,"
         " where the trajectory that waits begins in 0.040 s"),
        ({}, then(elbow(), elbow(node="/other"), go((1, 0), begin=1), keep(1, elbow(), elbow(0.1, "/other"))),
         f"{OTHER} does not report elbow on {JOINTS} within 0.075 rad (limit) of 0.000 rad,"
         " where the trajectory that waits begins in 0.040 s"),
        ({"stopDuration": 0.5}, then(elbow(), go((1, 9)), go(), waits(0.7)),
         f"an empty trajectory of {TELEOP} has waited for the end of a stop (limit 0.5 s)"),
    ],
}  # fmt: skip


@pytest.fixture
def time() -> Iterator[VirtualClock]:
    virtual = VirtualClock(wall=1.7e9)
    with clock.using(virtual):
        yield virtual


def stops_of(robot: Robot) -> set[tuple[int, str]]:
    """Return the places of `STOP` in the guard's text."""
    monitors = monitors_of(robot)
    found = (
        node.site
        for function in monitors.compiled.functions.values()
        for node in nodes.walk(function.body)
        if isinstance(node, nodes.StopMessage)
    )
    return {robot.place(str(monitors.interpreter.sites[site].position)) for site in found}


@pytest.mark.parametrize("preset", sorted(PRESETS.keys() - APART.keys()))
def test_each_stop_has_a_true_sentence_as_its_cause(preset: str, time: VirtualClock) -> None:
    missing, wrong = None, []
    for values, script, wanted in CASES[preset]:
        robot = Robot(preset, time, **values)
        missing = stops_of(robot) if missing is None else missing
        script(robot)
        found = robot.cause()
        missing -= robot.reached()
        wrong += [f"{found!r} instead of {wanted!r}"] if found != wanted else []
        full = [event for event in robot.events if not event.count]
        wrong += [f"no cause: {event}" for event in full if "cause" not in event.detail]
        wrong += [
            f"no sentence: {found}" for event in full if FALSE.search(str(event.detail.get("cause", "")))
        ]
    assert not wrong, "\n".join(wrong)
    assert missing == set()


def monitors_of(robot: Robot) -> MonitorSet:
    monitors = robot.interceptor.monitors
    assert monitors is not None
    return monitors


def garbage(given: str = "by", node: str = "/lidar") -> Step:
    """Send bytes that are not a message."""
    return lambda robot: robot.send(given, node, b"\xff" * 7)


def over_budget(robot: Robot) -> None:
    """Report a scan that was not judged."""
    outcome = Outcome(bytearray(), robot.interceptor.now())
    position = monitors_of(robot).monitor("guard").code.position
    outcome.faults = (Fault("guard", position, "it took too long", {}, over=True),)
    point = ObservationPoint("key", SCAN, HOSTS["/lidar"], "/lidar")
    robot.interceptor.observer.report(outcome, point)


def held_by_relay(robot: Robot) -> None:
    monitors_of(robot).hold(monitors_of(robot).monitor("guard"), "its file is lost")
    robot.wait(0.2)


def begun(robot: Robot) -> None:
    for enabled in (False, True):
        monitors_of(robot).switch({"guard": enabled}, robot.interceptor.now())
    robot.wait(0.2)


def stopped_by_operator(robot: Robot) -> None:
    monitors_of(robot).stop("/cmd_vel")
    robot.wait(0.2)


def test_the_example_of_rest_has_a_cause_of_its_preset() -> None:
    [guard] = EXAMPLES["GuardList"]["guards"]

    def in_general(cause: str) -> str:
        return re.sub(r"\d+\.\d+", "…", re.sub(r"/\w+ of [0-9.]+", "NODE", cause))

    causes = {in_general(cause) for _values, _script, cause in CASES[guard["preset"]]}
    assert in_general(guard["last_stop"]["cause"]) in causes


UNREAD = "no readable message from {} on {} since the guard began again"
OF_RELAY: list[tuple[str, Mapping[str, object], Step, str]] = [
    ("sensor", {}, begun, "no command on /cmd_vel since the guard began"),
    ("sensor", {}, stopped_by_operator, "no command on /cmd_vel since an operator stopped it"),
    ("sensor", {}, then(driven(scan), held_by_relay),
     "it holds its topics until an operator resumes it: its file is lost"),
    ("sensor", {}, then(driven(scan), garbage(), silent(0.2)), UNREAD.format(LIDAR, SCAN)),
    ("mode", {}, then(bool_of(False), garbage(), waits(0.2)), UNREAD.format(LIDAR, "/manual")),
    ("hold_to_run", {}, then(bool_of(False), bool_of(False, node="/other"), garbage(), waits(0.2)),
     UNREAD.format(f"{LIDAR}, {OTHER}", "/enable")),
    ("ready", FIX, then(driven(battery()), garbage("fix", "/other"), waits(0.2)), UNREAD.format(OTHER, "/fix")),
    ("ready", FIX, then(driven(battery()), garbage("fix", "/other"), sees(say("by", percentage=0.8))),
     UNREAD.format(OTHER, "/fix")),
    ("ready", {}, then(driven(battery()), garbage("fix", "/other"), sees(say("by", percentage=0.1))),
     f"{LIDAR} reports a charge of 0.1 on /battery_state (limits 0.2 and 1)"),
    ("sensor", {}, then(driven(scan), keep(0.6, over_budget)),
     f"a message of {LIDAR} on /scan was not judged: it took too long"),
    ("sensor", {}, then(driven(scan), over_budget, sees(wall(99.0))), NOT_VALID),
    ("sensor", {}, then(driven(scan), over_budget, waits(3), drive()), SILENT.format(SCAN, "3.05", "0.5")),
]  # fmt: skip


@pytest.mark.parametrize(("preset", "values", "script", "wanted"), OF_RELAY)
def test_the_relay_says_why_a_guard_cannot_judge(
    preset: str, values: Mapping[str, object], script: Step, wanted: str, time: VirtualClock
) -> None:
    """A silence of a topic is not said of messages that came; each other sentence of the guard stays."""
    robot = Robot(preset, time, **values)
    script(robot)
    assert robot.cause() == wanted
