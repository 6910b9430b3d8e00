"""Read from the graph which topics command a base or an arm, and which sources belong to the same robot.

1. Direction decides before names: a driver subscribes to a command, and does not pass it on to another command.
2. A source below the namespace of another robot never belongs to this one. A source below no robot's namespace
   belongs to the only robot, or to the one whose nodes use it.
3. An undecided source belongs to no robot; callers report it.
4. The work is bounded, since any host can add topics: `MOST_COMMANDS` of each kind, `_MOST_STEPS` back from a driver.
"""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from rosmop.types.roles import types_of_roles

# The message types that guards know, by the roles of topics in the language.

_ROLES = types_of_roles()
VELOCITIES = _ROLES["Velocity"]
TRAJECTORIES = _ROLES["Trajectory"]
GOALS = _ROLES["Goal"]
COMMANDS = _ROLES["Command"]
RESULTS = _ROLES["Result"]
POSES = _ROLES["Pose"]
SCANS = _ROLES["Scan"]
BATTERIES = _ROLES["Battery"]
DIAGNOSTICS = _ROLES["Diagnostics"]
VALUED = tuple(kind for kind in _ROLES["Sensor"] if "/" in kind)
"""The sensors whose values are judged; of all others, only the silence is."""
GOAL = "control_msgs/FollowJointTrajectoryActionGoal"


COMMAND = re.compile(r"cmd|command|setpoint|drive|ackermann", re.IGNORECASE)
_OBSERVER = re.compile(
    r"/(?:record|rosbag|rqt|rviz|rostopic|rosapi|rosbridge|foxglove|plotjuggler|rosout)[^/]*$"
)
_NOT_A_BASE = re.compile(
    r"(?:^|[/_])(?:arms?|servo|servo_server|jog|jog_arm_server|cartesian|twist_controller|manipulator|gripper|tool|tcp|ee"
    r"|ptu|pan_tilt|gimbal|head|torso)(?=[/_]|$)"
)  # fmt: skip
_JOINT_COMMANDS = {*TRAJECTORIES, "std_msgs/Float64MultiArray"}
_MEASURED = {*POSES, "sensor_msgs/LaserScan", "sensor_msgs/JointState", "sensor_msgs/Imu"}

MOST_COMMANDS = 20
_MOST_STEPS = 10

Namespace = tuple[str, ...]


class TopicFacts(NamedTuple):
    """A topic with its type, the nodes at both ends, its messages per second, and the hosts of these nodes."""

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rate: float = 0.0
    hosts: tuple[str, ...] = ()


@dataclass(frozen=True)
class GraphedRobot:
    """One robot of the graph: commands that have common drivers. `namespace` is empty if it is the only one."""

    namespace: Namespace
    commands: tuple[TopicFacts, ...]
    drivers: frozenset[str]
    chain: frozenset[str]
    """The drivers, and the nodes from which their commands come."""

    @property
    def title(self) -> str:
        return f"/{'/'.join(self.namespace)}" if self.namespace else self.commands[0].name


@dataclass(frozen=True)
class RobotGraph:
    """The topics of all robots on one master."""

    topics: tuple[TopicFacts, ...]

    @cached_property
    def velocities(self) -> list[TopicFacts]:
        """The topics named as commands of velocities, those between a node and a multiplexer too."""
        return [topic for topic in self.topics if topic.type in VELOCITIES and COMMAND.search(topic.name)]

    @cached_property
    def velocity_commands(self) -> list[TopicFacts]:
        """The topics by which drivers take velocities."""
        return [topic for topic in self.velocities if self.drivers(topic)][:MOST_COMMANDS]

    @cached_property
    def bases(self) -> list[TopicFacts]:
        return [topic for topic in self.velocity_commands if not self._moves_an_arm(topic)]

    @cached_property
    def arm_velocities(self) -> list[TopicFacts]:
        return [topic for topic in self.velocity_commands if self._moves_an_arm(topic)]

    @cached_property
    def arms(self) -> list[TopicFacts]:
        return [topic for topic in self.topics if topic.type in TRAJECTORIES and _used(topic)][:MOST_COMMANDS]

    @cached_property
    def robots(self) -> list[GraphedRobot]:
        groups: list[list[TopicFacts]] = []
        for command in (*self.bases, *self.arms, *self.arm_velocities):
            for group in groups:
                if any(self._same_robot(command, other) for other in group):
                    group.append(command)
                    break
            else:
                groups.append([command])
        return [self._robot(group, groups) for group in groups]

    def drivers(self, command: TopicFacts) -> frozenset[str]:
        """Return the subscribers that carry out a velocity, or nothing if all pass it on."""
        nodes = _used(command)
        passing = {
            node
            for other in self.velocities
            if other.name != command.name and _used(other)
            for node in other.publishers
        }
        driving = nodes - passing
        if len(nodes) > 1:  # a filter of positions may also use the commands
            driving = frozenset(node for node in driving if not self._filters_positions(node))
        return driving

    def ends(self, command: TopicFacts) -> frozenset[str]:
        """Return the nodes that carry out a command of any type."""
        return (self.drivers(command) if command.type in VELOCITIES else frozenset()) or _used(command)

    def robot_of(self, command: TopicFacts) -> GraphedRobot:
        return next(robot for robot in self.robots if command in robot.commands)

    def sources(self, command: TopicFacts, kinds: Iterable[str]) -> list[TopicFacts]:
        """Return the published topics of these types that belong to the command's robot."""
        wanted = {*kinds}
        return [
            topic
            for topic in self.topics
            if topic.type in wanted and topic.publishers and not COMMAND.search(topic.name)
            and self.belongs(topic, command)
        ]  # fmt: skip

    def shared(self, kinds: Iterable[str]) -> list[TopicFacts]:
        """Return the published topics of these types that are below no robot's namespace, and belong to none."""
        wanted, commands = {*kinds}, [robot.commands[0] for robot in self.robots]
        return [
            topic
            for topic in self.topics
            if topic.type in wanted and topic.publishers
            and not any(robot.namespace and _parts(topic.name)[: len(robot.namespace)] == robot.namespace
                        for robot in self.robots)
            and not any(self.belongs(topic, command) for command in commands)
        ]  # fmt: skip

    def belongs(self, source: TopicFacts, command: TopicFacts) -> bool:
        own = self.robot_of(command)
        others = [robot for robot in self.robots if robot is not own]
        place = _parts(source.name)
        inside = place[: len(own.namespace)] == own.namespace
        for other in others:
            below = bool(other.namespace) and place[: len(other.namespace)] == other.namespace
            if below and not (inside and len(own.namespace) > len(other.namespace)):
                return False
        if others:
            if inside and (own.namespace or all(other.namespace for other in others)):
                return True
            return _touches(source, own) and not any(_touches(source, other) for other in others)
        homes = {_parts(node)[:-1][:1] for node in own.drivers}
        of_another = (
            {_parts(node)[:-1][:1] for node in source.publishers} == {place[:1]}
            and len(place) > 1
            and not homes & {(), place[:1]}
        )
        return not of_another or _touches(source, own)

    def derived_from(self, topic: TopicFacts, others: Iterable[TopicFacts]) -> bool:
        """Whether a node makes the topic from one of the others: a filter, or a merger of scans."""
        return any(
            other.name != topic.name and not {*topic.publishers}.isdisjoint(other.subscribers)
            for other in others
        )

    def publishes(self, node: str, kinds: Iterable[str]) -> bool:
        wanted = {*kinds}
        return any(topic.type in wanted and node in topic.publishers for topic in self.topics)

    def unguarded(self, kinds: Collection[str]) -> list[TopicFacts]:
        """Return topics that no preset works with: with both ends and a command's name, or goals of a driver."""
        drivers = frozenset(node for robot in self.robots for node in robot.drivers)
        return [
            topic
            for topic in self.topics
            if topic.type not in kinds
            and (
                (COMMAND.search(topic.name) and topic.publishers and _used(topic))
                or (topic.type.endswith("ActionGoal") and not drivers.isdisjoint(topic.subscribers))
            )
        ]

    def _filters_positions(self, node: str) -> bool:
        used = any(
            topic.type == "nav_msgs/Odometry" and node in topic.subscribers and topic.publishers != (node,)
            for topic in self.topics
        )
        return used and self.publishes(node, POSES)

    def _moves_an_arm(self, command: TopicFacts) -> bool:
        if _NOT_A_BASE.search(command.name):
            return True
        drivers = self.drivers(command)
        measured = any(self.publishes(node, POSES) for node in drivers)
        return not measured and any(self.publishes(node, _JOINT_COMMANDS) for node in drivers)

    def _same_robot(self, one: TopicFacts, other: TopicFacts) -> bool:
        ours, theirs = _parts(one.name)[:-1], _parts(other.name)[:-1]
        if ours == theirs:
            return True
        if self.ends(one).isdisjoint(self.ends(other)):
            return one not in self.bases and bool(theirs) and ours[: len(theirs)] == theirs
        apart = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), None)
        if apart is None:
            return True
        heads = ours[: apart + 1], theirs[: apart + 1]
        return not all(  # a simulator drives several robots
            any(topic.type in _MEASURED and topic.publishers and _parts(topic.name)[: apart + 1] == head
                for topic in self.topics)
            for head in heads
        )  # fmt: skip

    def _robot(self, group: list[TopicFacts], groups: list[list[TopicFacts]]) -> GraphedRobot:
        places = [_parts(command.name)[:-1] for command in group]
        common = places[0]
        for place in places[1:]:
            same = next((i for i, (a, b) in enumerate(zip(common, place, strict=False)) if a != b), None)
            common = common[: min(len(common), len(place)) if same is None else same]
        others = [_parts(command.name)[:-1] for other in groups if other is not group for command in other]
        namespace = common if others else ()
        for length in range(1, len(common) + 1):
            if others and not any(place[:length] == common[:length] for place in others):
                namespace = common[:length]
                break
        drivers = frozenset(node for command in group for node in self.ends(command))
        chain = drivers.union(*(command.publishers for command in group))
        for _step in range(_MOST_STEPS):
            inputs = (topic for topic in self.velocities if not chain.isdisjoint(topic.subscribers))
            chain = chain.union(*(topic.publishers for topic in inputs))
        return GraphedRobot(namespace, tuple(group), drivers, chain)


def near(source: TopicFacts, command: TopicFacts) -> int:
    """Return how many levels of the namespace two topics share."""
    pairs = zip(_parts(source.name)[:-1], _parts(command.name)[:-1], strict=False)
    return next((level for level, (one, other) in enumerate(pairs) if one != other),
                min(len(_parts(source.name)), len(_parts(command.name))) - 1)  # fmt: skip


def _parts(name: str) -> Namespace:
    return tuple(name.strip("/").split("/"))


def _used(topic: TopicFacts) -> frozenset[str]:
    return frozenset(node for node in topic.subscribers if not _OBSERVER.search(node))


def _touches(source: TopicFacts, robot: GraphedRobot) -> bool:
    return not robot.chain.isdisjoint((*source.publishers, *source.subscribers))
