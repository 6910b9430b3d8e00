"""Judge by its topics whether a robot stands: which topics tell of its motions, and the speeds in their messages."""

import functools
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from appliance.rpc.master_reader import PUBLICATION, SUBSCRIPTION, MasterGraph
from roswire.definitions import Definitions
from roswire.message_view import read_fields
from roswire.standard import standard_definitions

STILL_SECONDS = 3.0
_SPEED = 0.01  # m/s, rad/s
_SHOWN = 3
_COMMANDS: Mapping[str, tuple[str, ...]] = {
    "geometry_msgs/Twist": (),
    "geometry_msgs/TwistStamped": ("twist",),
}
_ODOMETRY: Mapping[str, tuple[str, ...]] = {"nav_msgs/Odometry": ("twist", "twist")}
"""The fields above the twist, by the type of the topic."""
_COMMAND_NAME = re.compile(r"cmd|command|setpoint|drive", re.IGNORECASE)
_OBSERVER = re.compile(r"/(?:record_\d|rosbag|rqt|rviz|plotjuggler)[^/]*$")
"""Nodes that record or show topics, and drive nothing."""
_OTHER_COMMANDS = ("ackermann_msgs/", "control_msgs/", "mavros_msgs/", "std_msgs/Float64", "trajectory_msgs/")
"""The beginnings of types that command a motion in a way that is not read here."""


@dataclass(frozen=True)
class MotionTopics:
    """The topics that tell of a robot's motions. `commands` has the odometry of the drivers of each command topic.

    The odometry is empty if a driver measures none. `others` are command topics of other hosts.
    """

    commands: Mapping[str, frozenset[str]]
    odometry: frozenset[str]
    others: tuple[str, ...] = ()


@dataclass
class StandingJudge:
    """Decides whether a robot stands, by the speeds that its topics say. Times are in seconds of one clock."""

    topics: MotionTopics
    seconds: float = STILL_SECONDS
    deaf: str = ""
    """Why a topic cannot be heard."""
    _moved: dict[str, float] = field(default_factory=dict, init=False)
    _still_since: dict[str, float] = field(default_factory=dict, init=False)
    _heard: dict[str, float] = field(default_factory=dict, init=False)

    def hear(self, topic: str, speed: float, now: float) -> None:
        self._heard[topic] = now
        if speed <= _SPEED:  # a speed that is not a number moves
            self._still_since.setdefault(topic, now)
        else:
            self._moved[topic] = now
            self._still_since.pop(topic, None)

    @property
    def commanded(self) -> list[str]:
        """The command topics whose last command was zero."""
        return sorted(self.topics.commands.keys() & self._still_since)

    @property
    def silent(self) -> list[str]:
        """The command topics without a command."""
        return sorted(self.topics.commands.keys() - self._heard)

    def why_not(self, now: float) -> str:
        """Return why the robot is not known to stand; empty if it stands."""
        commands, odometry = self.topics.commands, self.topics.odometry
        if self.deaf:
            return self.deaf
        if not commands:
            elsewhere = f"; of other hosts: {some(self.topics.others)}" if self.topics.others else ""
            return f"no topic commands a base of this robot (geometry_msgs/Twist){elsewhere}"
        for topic in sorted((commands.keys() | odometry) & self._moved.keys()):
            if topic not in self._still_since:
                return f"{topic} says that it moves"
        commanded = self.commanded
        unknown = [topic for topic in self.silent if not commanded or not commands[topic]]
        if unknown:
            return f"no zero was commanded on {', '.join(unknown)}"
        for topic in sorted(odometry):
            if now - self._heard.get(topic, -math.inf) > self.seconds:
                return f"{topic} is silent"
        still = max(self._still_since[topic] for topic in {*commanded, *odometry})
        left = self.seconds - (now - still)
        return f"it stands for less than {self.seconds:g} s" if left > 0 else ""


def unseen(graph: MasterGraph, topics: MotionTopics, silent: Collection[str] = ()) -> str:
    """Return in words what the topics of a graph do not tell about motions."""
    parts = [] if topics.odometry else ["the real speed, because no node publishes odometry"]
    if silent:
        parts.append(f"a command on {some(silent)}")
    used = {resource for kind, resource, _name in graph.entries if kind == SUBSCRIPTION}
    others = sorted(topic for topic in used if graph.types.get(topic, "").startswith(_OTHER_COMMANDS))
    if others:
        parts.append(f"what {some(others)} may move")
    if topics.others:
        parts.append(f"what {some(topics.others)} of other hosts may move")
    parts.append("motions that no topic commands")
    return "; ".join(parts)


def some(topics: Collection[str]) -> str:
    listed = sorted(topics)
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return f"{', '.join(listed[:_SHOWN])}{more}"


def motion_topics(graph: MasterGraph, own: Collection[str]) -> MotionTopics:
    """Return the topics that tell of the motions of a robot with these nodes.

    A driver subscribes to a command, and passes it on to no other node of the robot, as a multiplexer does. A recorder
    or a display does not drive.
    """
    ends: dict[str, dict[str, set[str]]] = {PUBLICATION: {}, SUBSCRIPTION: {}}
    for kind, topic, name in graph.entries:
        if kind in ends and not (kind == SUBSCRIPTION and _OBSERVER.search(name)):
            ends[kind].setdefault(topic, set()).add(name)
    publishers, subscribers = ends[PUBLICATION], ends[SUBSCRIPTION]
    twists = [topic for topic in subscribers if graph.types.get(topic) in _COMMANDS]
    measured = {topic: publishers[topic] for topic in publishers if graph.types.get(topic) in _ODOMETRY}
    passing = {
        name
        for topic in twists
        if _COMMAND_NAME.search(topic)
        for name in publishers.get(topic, ())
        if not subscribers[topic].isdisjoint({*own} - {name})
    }
    commands, others, driving = dict[str, frozenset[str]](), list[str](), set[str]()
    for topic in sorted(twists):
        drivers = subscribers[topic] - passing
        if drivers.isdisjoint(own) and publishers.get(topic, set()).isdisjoint(own):
            others += [topic] if drivers else []
        elif drivers:
            sources = [{one for one, names in measured.items() if name in names} for name in drivers]
            commands[topic] = frozenset[str]().union(*sources) if all(sources) else frozenset()
            driving |= drivers
    odometry = {topic for topic, names in measured.items() if not names.isdisjoint(driving.union(own))}
    return MotionTopics(commands, frozenset(odometry), tuple(others))


def speed_in(kind: str, data: bytes) -> float:
    """Return the largest component of a message's twist; infinity for a message that cannot be read."""
    return speed_of(kind, read_fields(_definitions(), kind, data))


def speed_of(kind: str, message: object) -> float:
    fields = message
    for name in {**_COMMANDS, **_ODOMETRY}.get(kind, ()):
        fields = fields.get(name) if isinstance(fields, dict) else None
    if not isinstance(fields, dict):
        return math.inf
    parts = [fields.get(part) for part in ("linear", "angular")]
    values = [value for part in parts if isinstance(part, dict) for value in part.values()]
    if not values or any(not isinstance(value, float) or math.isnan(value) for value in values):
        return math.inf
    return float(max(map(abs, values)))


@functools.cache
def _definitions() -> Definitions:
    return standard_definitions()
