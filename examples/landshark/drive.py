"""A drive of the simulated LandShark, computed without ROS: `python -m examples.landshark.drive`.

    --bag FILE   record what the robot's nodes and its operator publish, as `rosbag record -a` would
    --svg FILE   draw the drive without monitors and the same commands with the monitors of `monitors/`

As in the appliance, the messages of a topic go through the monitors before a subscriber gets them, so the robot moves
as the monitors permit. Everything is deterministic.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.rosbag1 import Writer

from examples.landshark.messages import DEFINITIONS, MONITORS, TRIGGER, Messages, long_name
from examples.landshark.nodes import physics
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

SHIPPED = tuple(sorted(MONITORS.glob("*.rv")))
START = 1_700_000_000 * 10**9
STEP = 50_000_000  # nanoseconds: the base and the turret work at 20 Hz
MOMENT = 10_000  # nanoseconds between two messages, so that they have an order in the recording
BEAMS = 61
FIELD_OF_VIEW = math.radians(120)
VELOCITY, TRIGGERED = "/landshark_control/base_velocity", "/landshark_control/trigger"
TYPES = {
    "/landshark/odom": "nav_msgs/Odometry",
    "/landshark/joint_states": "sensor_msgs/JointState",
    "/landshark/gps": "sensor_msgs/NavSatFix",
    "/landshark/scan": "sensor_msgs/LaserScan",
    "/landshark/battery": "sensor_msgs/BatteryState",
    VELOCITY: "geometry_msgs/TwistStamped",
    "/landshark_control/turret": "sensor_msgs/JointState",
    TRIGGERED: TRIGGER,
    "/landshark/obstacle_alarm": "std_msgs/String",
}


@dataclass(frozen=True)
class Part:
    """The operator's commands for some seconds. The gun is aimed at the beginning and fired in the middle."""

    seconds: float
    forward: float = 0.0
    turn: float = 0.0
    tilt: float | None = None
    fire: bool = False


MISSION = (
    Part(1.0, tilt=0.2),
    Part(1.0, fire=True),  # over the yard
    Part(9.0, forward=1.0),  # at the obstacle
    Part(2.0, forward=-1.0),
    Part(math.pi / 2 / 0.8, turn=0.8),
    Part(1.5, tilt=-0.7),
    Part(1.0, fire=True),  # at the robot itself
    Part(1.0, tilt=0.3),
    Part(1.0, fire=True),
    Part(12.0, forward=2.0),  # out of the yard
    Part(1.5, forward=-1.0),
    Part(math.pi * 0.8 / 0.8, turn=0.8),
    Part(6.0, forward=1.5),
)


@dataclass(frozen=True)
class Message:
    """A published message. `result` is passed, changed or dropped."""

    time: int
    topic: str
    data: bytes
    result: str


@dataclass(frozen=True)
class Shot:
    """A pull of the trigger. `fired` is whether the driver got the message."""

    time: int
    tilt: float
    pose: physics.Pose
    fired: bool


@dataclass
class Drive:
    poses: list[physics.Pose] = field(default_factory=list)
    tilts: list[float] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    log: list[tuple[int, str]] = field(default_factory=list)

    def nearest(self, obstacle: physics.Obstacle) -> float:
        """Return the smallest distance from the obstacle's edge in metres, negative inside it."""
        return (
            min(math.hypot(pose.x - obstacle.x, pose.y - obstacle.y) for pose in self.poses) - obstacle.radius
        )

    def farthest(self) -> float:
        """Return the largest distance from the origin in metres."""
        return max(math.hypot(pose.x, pose.y) for pose in self.poses)


class Simulation:
    def __init__(self, specifications: Sequence[Path] = ()) -> None:
        self.drive = Drive()
        self.laser_works = True
        self._messages = Messages()
        self._now = START
        self._pose, self._turret, self._wanted = physics.Pose(), physics.Turret(), physics.Turret()
        self._velocity, self._told, self._charge = physics.Velocity(), START, 1.0
        definitions = standard_definitions().merge(Definitions.from_files(DEFINITIONS))
        texts = {file.name: file.read_text(encoding="utf-8") for file in specifications}
        self._monitors = MonitorSet.of(compiled_from(texts, definitions))
        self._monitors.start(START)

    def run(self, mission: Sequence[Part] = MISSION) -> Drive:
        ticks, began = 0, self._now
        for part in mission:
            count = round(part.seconds * 10**9 / STEP)
            for tick in range(count):
                if part.tilt is not None and tick == 0:
                    self._command_turret(part.tilt)
                if part.fire and tick == count // 2:
                    self._fire()
                if ticks % 2 == 0:
                    self._command_velocity(part)
                self._move()
                self._tell(ticks)
                ticks += 1
                self._now = began + ticks * STEP
        return self.drive

    def _send(self, topic: str, **fields: object) -> bytes | None:
        """Return the bytes that subscribers get, or None if a monitor dropped the message."""
        data = self._messages.encode(
            TYPES[topic],
            header__stamp__sec=self._now // 10**9,
            header__stamp__nanosec=self._now % 10**9,
            **fields,
        )
        outcome = self._monitors.process(topic, bytearray(data), self._now)
        self.drive.messages.append(Message(self._now, topic, data, outcome.result))
        self.drive.log += [(self._now, line.text) for line in outcome.log]
        for published in outcome.published:
            self.drive.messages.append(Message(self._now, published.topic, published.data, "passed"))
        self._now += MOMENT
        return None if outcome.result == "dropped" else bytes(outcome.buffer)

    def _command_velocity(self, part: Part) -> None:
        data = self._send(VELOCITY, twist__linear__x=part.forward, twist__angular__z=part.turn)
        if data is not None:
            twist = self._messages.decode(TYPES[VELOCITY], data).twist
            self._velocity = physics.possible(physics.Velocity(twist.linear.x, twist.angular.z))
            self._told = self._now

    def _command_turret(self, tilt: float) -> None:
        topic = "/landshark_control/turret"
        data = self._send(topic, name=["turret_pan", "turret_tilt"], position=[0.0, tilt])
        if data is not None:
            pan, tilt = self._messages.decode(TYPES[topic], data).position
            self._wanted = physics.Turret(float(pan), float(tilt))

    def _fire(self) -> None:
        data = self._send(TRIGGERED, trigger=1)
        self.drive.shots.append(Shot(self._now, self._turret.tilt, self._pose, data is not None))

    def _move(self) -> None:
        if self._now - self._told > physics.COMMAND_LIFETIME * 10**9:
            self._velocity = physics.Velocity()
        self._pose = physics.drive(self._pose, self._velocity, STEP / 10**9)
        self._turret = physics.aim(self._turret, self._wanted, STEP / 10**9)
        self._charge = physics.drained(self._charge, self._velocity.forward, STEP / 10**9)
        self.drive.poses.append(self._pose)
        self.drive.tilts.append(self._turret.tilt)

    def _tell(self, ticks: int) -> None:
        pose, velocity = self._pose, self._velocity
        self._send(
            "/landshark/odom",
            pose__pose__position={"x": pose.x, "y": pose.y},
            pose__pose__orientation={"z": math.sin(pose.heading / 2), "w": math.cos(pose.heading / 2)},
            twist__twist__linear__x=velocity.forward,
            twist__twist__angular__z=velocity.turn,
        )
        names = ["turret_pan", "turret_tilt"]
        self._send("/landshark/joint_states", name=names, position=[self._turret.pan, self._turret.tilt])
        if ticks % 2 == 0 and self.laser_works:
            step = FIELD_OF_VIEW / (BEAMS - 1)
            ranges = physics.scan(pose, [step * beam - FIELD_OF_VIEW / 2 for beam in range(BEAMS)])
            limits = {
                "angle_min": -FIELD_OF_VIEW / 2,
                "angle_max": FIELD_OF_VIEW / 2,
                "angle_increment": step,
            }
            self._send("/landshark/scan", range_min=0.05, range_max=30.0, ranges=ranges, **limits)
        if ticks % 4 == 0:
            latitude, longitude = physics.position_on_earth(pose)
            self._send("/landshark/gps", latitude=latitude, longitude=longitude)
        if ticks % 20 == 0:
            self._send(
                "/landshark/battery", percentage=self._charge, voltage=22.0 + 4.0 * self._charge, present=True
            )


def record(drive: Drive, path: Path) -> None:
    if path.exists():
        raise FileExistsError(f"{path} already exists")
    store = Messages().store
    with Writer(path) as writer:
        connections = {}
        for message in drive.messages:
            if message.topic not in connections:
                kind = long_name(TYPES[message.topic])
                connections[message.topic] = writer.add_connection(message.topic, kind, typestore=store)
            writer.write(connections[message.topic], message.time, message.data)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--bag", type=Path, metavar="FILE", help="record the drive without monitors")
    parser.add_argument("--svg", type=Path, metavar="FILE", help="draw the drive without and with monitors")
    options = parser.parse_args()
    without, guarded = Simulation().run(), Simulation(SHIPPED).run()
    for name, drive in (("without monitors", without), ("with monitors", guarded)):
        fired = "".join("fired " if shot.fired else "dropped " for shot in drive.shots)
        print(
            f"{name}: {drive.nearest(physics.YARD[0]):.2f} m from the obstacle at the nearest, "
            f"{drive.farthest():.2f} m from the origin at the farthest, shots: {fired.strip()}"
        )
    if options.bag is not None:
        record(without, options.bag)
    if options.svg is not None:
        from examples.landshark.picture import draw  # noqa: PLC0415  it shows what this module makes

        options.svg.write_text(draw(without, guarded), encoding="utf-8")


if __name__ == "__main__":
    main()
