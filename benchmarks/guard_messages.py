"""The cost of a guard for one message: `python -m benchmarks.guard_messages`.

Each preset runs with its defaults in the engine and module of a relay. Each of its topics gets 50 messages a second, of
a robot that stands for two seconds and then drives slowly. A time is the median of the processor time of 2,000 messages
on that topic, caches warm, without the guard's ticks. Where the last release has the preset, its text runs beside the
present one, message by message: the ratio is what the changes cost.

With `--deployed`, lone scans of 1,080 rays go from a rospy node to another through an appliance, in turns on a topic
that no monitor reads, on one for each preset that reads scans, and on one with a monitor that does nothing. Before
each, a motion is commanded. The delay is from `publish` until the callback, and its ratio is to that without a monitor.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from rosbags.typesys import get_types_from_msg

from appliance.channel.admin import MonitorsWanted
from appliance.features.guards.presets import PRESETS, Guard, Preset, text_of
from appliance.features.guards.released import FOLDER, released_preset
from benchmarks.cold import realtime
from benchmarks.relay_throughput import HERE
from rosmop.run.engine import MonitorSet
from rosmop.run.fast_path import BatchOptions, FastLane
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import STORE, message
from tests.support.appliance import Appliance
from tests.support.features.guards.running_guard import DEFINITIONS, on_its_module, part_of
from tests.support.nodes import PYTHON, RosSession

MESSAGES = 2_000
STANDING = 100
"""The messages on each topic before the robot drives."""
PERIOD_NS = 20_000_000

Body = Callable[[int], bytes]
"""The bytes of the message with this number on its topic."""


def always(body: bytes) -> Body:
    return lambda _number: body


def twist(number: int) -> bytes:
    return message("geometry_msgs/Twist", linear__x=0.2 if number >= STANDING else 0.0)


def scan(number: int) -> bytes:
    ranges = [5.0 + (number + ray) % 7 / 100 for ray in range(360)]
    return message(
        "sensor_msgs/LaserScan", angle_min=-3.14, angle_max=3.14, angle_increment=6.28 / 359, range_min=0.1,
        range_max=30.0, ranges=ranges,
    )  # fmt: skip


def odometry(number: int) -> bytes:
    x = max(0, number - STANDING) % 50 / 250
    return message(
        "nav_msgs/Odometry", header__frame_id="odom", pose__pose__position__x=x, pose__pose__orientation__w=1.0,
        twist__twist__linear__x=0.2 if number >= STANDING + 5 else 0.0,
    )  # fmt: skip


def trajectory(joints: int, points: int) -> Body:
    path = [
        {
            "positions": [0.001 * point] * joints,
            "velocities": [0.01] * joints,
            "time_from_start": {"sec": point + 1, "nanosec": 0},
        }
        for point in range(points)
    ]
    return always(message("trajectory_msgs/JointTrajectory", joint_names=JOINTS[:joints], points=path))


def goal(number: int) -> bytes:
    return message("move_base_msgs/MoveBaseActionGoal", goal_id__id=f"goal-{number // 2}")


def result(number: int) -> bytes:
    return message(
        "move_base_msgs/MoveBaseActionResult", status__goal_id__id=f"goal-{number // 2}", status__status=3
    )


for _kind in ("MoveBaseGoal", "MoveBaseResult", "MoveBaseActionGoal", "MoveBaseActionResult"):
    STORE.register(
        get_types_from_msg(DEFINITIONS.message(f"move_base_msgs/{_kind}").text, f"move_base_msgs/msg/{_kind}")
    )
JOINTS = [f"joint_{number}" for number in range(7)]
OFF = always(message("std_msgs/Bool"))
HELD = message("std_msgs/Bool", data=1)


def enabling(number: int) -> bytes:
    """Return a device that is let go once before it is held, as `enable` asks for."""
    return HELD if number >= STANDING // 2 else OFF(number)


BODIES: Mapping[str, Body] = {
    "geometry_msgs/Twist": twist,
    "sensor_msgs/LaserScan": scan,
    "nav_msgs/Odometry": odometry,
    "sensor_msgs/BatteryState": always(message("sensor_msgs/BatteryState", percentage=0.8)),
    "sensor_msgs/Image": always(message("sensor_msgs/Image", height=48, width=64, step=192, data=[7] * 9216)),
    "sensor_msgs/JointState": always(message("sensor_msgs/JointState", name=JOINTS, position=[0.0] * 7)),
    "move_base_msgs/MoveBaseActionGoal": goal,
    "move_base_msgs/MoveBaseActionResult": result,
    "std_msgs/Bool": OFF,
}
"""The messages by their type; a guard's first type of a topic is the one measured."""
OTHERWISE: Mapping[tuple[str, str], Body] = {("enable", "by"): enabling}
TRAJECTORIES = {"6 joints, 1 point": (6, 1), "6 joints, 10 points": (6, 10), "7 joints, 50 points": (7, 50)}


class Row(NamedTuple):
    preset: str
    topic: str
    """The preset's name for it."""
    bodies: Mapping[str, Body]
    what: str = ""


def rows() -> Iterator[Row]:
    for name, preset in PRESETS.items():
        bodies = {
            topic: OTHERWISE.get((name, topic)) or BODIES[types[0]]
            for topic, types in preset.topics.items()
            if types[0] in BODIES
        }
        if name == "joints":
            for what, (joints, points) in TRAJECTORIES.items():
                yield Row(name, "command", bodies | {"command": trajectory(joints, points)}, what)
            yield Row(name, "state", bodies | {"command": trajectory(6, 1)}, "7 joints")
            continue
        bodies |= {topic: OFF for topic in ("stop", "reset") if topic in preset.given_topics}
        for topic in bodies:
            yield Row(name, topic, bodies)


class Running:
    """A guard in an engine with its module."""

    def __init__(self, preset: Preset, text: str) -> None:
        self._topics = preset.given_topics
        self._prepared: dict[tuple[FastLane, int], BatchOptions] = {}
        self._monitors: MonitorSet = on_its_module(part_of(text))
        self._monitors.name_senders(lambda source: (f"10.0.0.{source}", f"/node{source}"))
        self._monitors.start(0)

    def takes(self, name: str) -> bool:
        return self._topics.get(name) in self._monitors.topics

    def advance(self, now: int) -> None:
        self._monitors.advance(now)

    def tell(self, name: str, body: bytes, now: int) -> tuple[int, Outcome]:
        """Return the nanoseconds of processor time that the message took, and what became of it."""
        topic, buffer, source = self._topics[name], bytearray(body), 1 + list(self._topics).index(name)
        began = time.thread_time_ns()
        outcome = self._monitors.process_fast(topic, buffer, now, lambda lane: self._options(lane, source))
        if outcome is None:
            outcome = self._monitors.process(topic, buffer, now, MessageSender(source))
        return time.thread_time_ns() - began, outcome

    def _options(self, lane: FastLane, source: int) -> BatchOptions:
        """Return the options that a relay keeps for each publisher."""
        found = self._prepared.get((lane, source))
        if found is None:
            found = lane.prepare(loud=False, told=[True] * len(lane.events), source=source)
            self._prepared[lane, source] = found
        return found


def measured(row: Row, guards: list[Running]) -> tuple[list[float], str]:
    """Return the microseconds of a message for each of the guards, and what the first did with most of them."""
    times: list[list[int]] = [[] for _ in guards]
    results: list[str] = []
    for number in range(STANDING + MESSAGES):
        now = number * PERIOD_NS + 1
        for index, guard in enumerate(guards):
            guard.advance(now)
            for name, body in row.bodies.items():
                if name != row.topic and guard.takes(name):
                    guard.tell(name, body(number), now)
            spent, outcome = guard.tell(row.topic, row.bodies[row.topic](number), now)
            if number >= STANDING:
                times[index].append(spent)
                if index == 0:
                    results.append(outcome.result)
    idle = overhead()
    return [statistics.median(moment) / 1e3 - idle for moment in times], statistics.mode(results)


def overhead() -> float:
    """Return the microseconds that reading the clock adds to a time."""
    spans = []
    for _ in range(MESSAGES):
        began = time.thread_time_ns()
        spans.append(time.thread_time_ns() - began)
    return statistics.median(spans) / 1e3


def last_release(name: str) -> Preset | None:
    versions = [int(path.stem.rpartition("-")[2]) for path in FOLDER.glob(f"{name}-*.rv")]
    return released_preset(name, max(versions)) if versions else None


def deployed(rays: int, scans: int) -> int:
    reading = [
        (preset, name)
        for preset in PRESETS.values()
        for name, types in preset.topics.items()
        if name != "command" and types[0] == "sensor_msgs/LaserScan"
    ]
    texts = {
        preset.name: text_of(
            Guard(
                preset.name, preset, {"command": f"/{preset.name}_command", name: f"/{preset.name}"},
                values={"silent": "10"},
            )
        )
        for preset, name in reading
    }  # fmt: skip
    texts["idle"] = "idle() { event scan() /idle sensor_msgs/LaserScan '{}' { } }"
    topics = ["/none", *(f"/{name}" for name in texts)]
    with (
        Appliance(monitors=texts) as appliance,
        tempfile.TemporaryDirectory() as home,
        RosSession(appliance.master_uri, Path(home)) as session,
    ):
        appliance.rosrv("monitor", "enable", *texts)
        command = [
            *realtime(),
            PYTHON,
            str(HERE / "nodes" / "stopped_node.py"),
            str(scans),
            str(rays),
            *topics,
        ]
        took = session.start(command).wait_for(event="measured", timeout=120 + scans)["took"]
        faults = {monitor.name: monitor.faults for monitor in appliance.ask(MonitorsWanted()).monitors}
    for topic in topics:
        came = [one for one in took[topic] if one is not None]
        ratio = statistics.median(came) / statistics.median(took["/none"])
        cuts = statistics.quantiles(came, n=100)
        sys.stdout.write(
            f"{topic[1:]:11} {rays} rays: {len(came)} of {scans} came, 50 % {cuts[49]:.2f} ms, 99 % {cuts[98]:.2f} ms,"
            f" ratio {ratio:.2f}, {faults.get(topic[1:], 0)} faults\n"
        )
    return 0


def main() -> int:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    arguments.add_argument("--deployed", action="store_true")
    arguments.add_argument("--rays", type=int, default=1080)
    arguments.add_argument("--scans", type=int, default=400)
    given = arguments.parse_args()
    if given.deployed:
        return deployed(given.rays, given.scans)
    sys.stdout.write(
        f"{'preset':11} {'topic':8} {'message':22} {'became':9} {'µs':>7} {'released':>9} {'ratio':>6}\n"
    )
    for row in rows():
        preset = PRESETS[row.preset]
        guards = [Running(preset, text_of(Guard(row.preset, preset)))]
        before = last_release(row.preset)
        if before is not None:
            older = Running(before, before.text)
            if older.takes(row.topic):
                guards.append(older)
        spent, became = measured(row, guards)
        peer = f" {spent[1]:9.1f} {spent[0] / spent[1]:6.2f}" if len(spent) > 1 else ""
        what = row.what or preset.topics.get(row.topic, ("std_msgs/Bool",))[0].partition("/")[2]
        sys.stdout.write(f"{row.preset:11} {row.topic:8} {what:22} {became:9} {spent[0]:7.1f}{peer}\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
