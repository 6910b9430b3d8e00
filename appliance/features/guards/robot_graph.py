"""Read from the graph which topics command a base or an arm, and which sources belong to the same robot.

1. Direction decides before names: a driver subscribes to a command, and does not pass it on to another command. A
   velocity that a driver subscribes to is a command, and one that it reports is not.
2. A source below the namespace of another robot never belongs to this one. A source below no robot's namespace
   belongs to the only robot, or to the one whose nodes use it.
3. An undecided source belongs to no robot; callers report it.
4. The work is bounded, since any host can add topics: `MAX_TOPICS` that the hosts share, `MAX_COMMANDS` of each kind,
   `_MAX_STEPS` back from a driver.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
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
JOY = "sensor_msgs/Joy"
CLOUD = "sensor_msgs/PointCloud2"
BOOL = "std_msgs/Bool"
_READ = {
    *COMMANDS, *GOALS, *RESULTS, *POSES, *SCANS, *BATTERIES, *DIAGNOSTICS, BOOL, JOY, CLOUD,
    "sensor_msgs/JointState", "sensor_msgs/Imu", "geometry_msgs/PoseArray",
}  # fmt: skip
"""The types from which a graph follows."""


COMMAND = re.compile(r"cmd|command|setpoint|drive|ackermann", re.IGNORECASE)
STOP = re.compile(r"e_?stop|emergency(?:_stop)?|protective_stop|run_?stop(?:ped)?", re.IGNORECASE)
_OBSERVER = re.compile(
    r"/(?:record|rosbag|rqt|rviz|rostopic|rosapi|rosbridge|foxglove|plotjuggler|rosout)[^/]*$"
)
_NOT_A_BASE = re.compile(
    r"(?:^|[/_])(?:arms?|servo|servo_server|jog|jog_arm_server|cartesian|twist_controller|manipulator|gripper|tool|tcp|ee"
    r"|ptu|pan_tilt|gimbal|head|torso)(?=[/_]|$)"
)  # fmt: skip
_JOINT_COMMANDS = {*TRAJECTORIES, "std_msgs/Float64MultiArray"}
_MEASURED = {*POSES, "sensor_msgs/LaserScan", "sensor_msgs/JointState", "sensor_msgs/Imu"}
_OF_A_DRIVER = {"nav_msgs/Odometry", "sensor_msgs/JointState"}
_A_MEASUREMENT = re.compile(
    r"wheel|encoder|odom|measured|actual|feedback|estimat|vision|imu|gps|gnss|filtered|local_position|state",
    re.IGNORECASE,
)
"""In the name of a velocity that nothing but its subscribers shows to be a command."""
_ESTIMATOR = re.compile(r"odom|ekf|ukf|locali[sz]|fusion|estimat|slam|track", re.IGNORECASE)
"""In the name of a node that does not drive."""
SIDE = re.compile(r"(?:^|[/_])(?:f|b|r|l|front|back|rear|left|right)(?=[/_]|$)", re.IGNORECASE)

MAX_TOPICS = 500
MAX_COMMANDS = 20
_MAX_STEPS = 10

Namespace = tuple[str, ...]


class TopicFacts(NamedTuple):
    """A topic with its type, the nodes at both ends, its messages per second, and the hosts of these nodes."""

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rate: float = 0.0
    hosts: tuple[str, ...] = ()
    rates: tuple[float, ...] = ()
    """The messages per second of each publisher, if they are known."""

    def slowest(self, *, sending: bool = False) -> float:
        """Return the rate of the slowest publisher, or of the slowest that sends now."""
        rates = self.rates or (self.rate / max(len(self.publishers), 1),)
        return min((rate for rate in rates if rate > 0 or not sending), default=0.0)


@dataclass(frozen=True)
class GraphedRobot:
    """One robot of the graph: commands that have common drivers. `namespace` is empty if it is the only one."""

    namespace: Namespace
    commands: tuple[TopicFacts, ...]
    drivers: frozenset[str]
    chain: frozenset[str]
    """The drivers, and the nodes from which their commands come."""
    prefixed: bool = False
    """Its topics have a prefix, such as `r1_`, instead of a namespace."""

    @property
    def title(self) -> str:
        return self.name_of("…").removesuffix("/…") if self.namespace else self.commands[0].name

    def name_of(self, leaf: str) -> str:
        """Return the name of a topic of this robot."""
        return f"/{'/'.join(self.namespace)}{'_' if self.prefixed else '/'}{leaf}"


class RobotGraph:
    """The topics of all robots on one master that say something about commands, `MAX_TOPICS` of them."""

    def __init__(self, topics: Iterable[TopicFacts], named: Collection[str] = ()) -> None:
        """Keep the topics with these names first, then those of their nodes; `complete` if none is left out."""
        kept = [*_by_host((topic for topic in topics if topic.name in named or _is_read(topic)), named)]
        self.topics, self.complete = kept[:MAX_TOPICS], len(kept) <= MAX_TOPICS

    @cached_property
    def velocities(self) -> list[TopicFacts]:
        """The topics that command velocities, those between a node and a multiplexer too.

        Their name says so; or a node subscribes to them that carries out, passes on or publishes another command; or a
        node makes them from a command of the same type. In a graph without any of these, the subscriber reports how the
        robot moves. But a name of a measurement is none of a command.
        """
        directed = [topic for topic in self.topics if topic.type in VELOCITIES and not self._reports(topic)]
        found = [topic for topic in directed if COMMAND.search(topic.name)]
        names = {topic.name for topic in found}
        others = [topic for topic in directed if topic.name not in names and self._carrying_out(topic)]
        for _step in range(_MAX_STEPS):
            takers = {node for topic in found for node in _used(topic)}
            senders = {node for topic in found if _used(topic) for node in topic.publishers}
            kinds = {topic.type for topic in found}
            more = [
                topic
                for topic in others
                if not _A_MEASUREMENT.search(topic.name) and topic.name not in names
                and not ((topic.type not in kinds or takers.isdisjoint(topic.publishers))
                         and (takers | senders).isdisjoint(self._carrying_out(topic)))
            ]  # fmt: skip
            found += more
            names |= {topic.name for topic in more}
            if not more:
                break
        names = names or {topic.name for topic in self._of_drivers(others)}
        return [topic for topic in self.topics if topic.name in names]

    @cached_property
    def undecided(self) -> list[TopicFacts]:
        """The velocities that some node uses, and that neither a name nor the graph shows to be commands or not."""
        return [
            topic for topic in self.topics
            if topic.type in VELOCITIES and topic.publishers and self._carrying_out(topic)
            and topic not in self.velocities and (COMMAND.search(topic.name) or not self._reports(topic))
        ]  # fmt: skip

    def _of_drivers(self, velocities: Iterable[TopicFacts]) -> list[TopicFacts]:
        return [
            topic
            for topic in velocities
            if not _A_MEASUREMENT.search(topic.name)
            and not self._measuring.isdisjoint(self._carrying_out(topic))
        ]

    def _carrying_out(self, velocity: TopicFacts) -> list[str]:
        return [
            node
            for node in _used(velocity)
            if node not in self._filters and not _ESTIMATOR.search(node.rsplit("/", 1)[1])
        ]

    @cached_property
    def _measuring(self) -> frozenset[str]:
        return frozenset(
            node for topic in self.topics if topic.type in _OF_A_DRIVER for node in topic.publishers
        )

    def _reports(self, velocity: TopicFacts) -> bool:
        """Whether only drivers publish it: nodes that report how the robot moves.

        With a command's name, they also take another command, and no driver subscribes to it.
        """
        named = COMMAND.search(velocity.name) and not (
            self._measuring.isdisjoint(_used(velocity)) and self._commanded.issuperset(velocity.publishers)
        )
        return bool(velocity.publishers) and not named and self._measuring.issuperset(velocity.publishers)

    @cached_property
    def _commanded(self) -> frozenset[str]:
        return frozenset(
            node
            for topic in self.topics
            if topic.type in VELOCITIES and COMMAND.search(topic.name)
            for node in topic.subscribers
        )

    @cached_property
    def _prefixes(self) -> frozenset[str]:
        """The prefixes that stand for namespaces: `r1` of `/r1_cmd_vel`, with another driver than `/r2_cmd_vel`."""
        found = set[str]()
        for one, other in combinations((*self.bases, *self.arms), 2):
            (head, _, rest), (other_head, _, other_rest) = (
                topic.name.strip("/").partition("_") for topic in (one, other)
            )
            heads = {head, other_head}
            if len(heads) == 2 and rest and rest == other_rest and not any(map(SIDE.fullmatch, heads)) and (
                self.ends(one).isdisjoint(self.ends(other)) or all(map(self._measured_below, heads))
            ):  # fmt: skip
                found |= heads
        return frozenset(head for head in found if head and "/" not in head)

    def _measured_below(self, prefix: str) -> bool:
        return any(
            topic.type in _MEASURED and topic.publishers and topic.name.startswith(f"/{prefix}_")
            for topic in self.topics
        )

    def _parts(self, name: str) -> Namespace:
        first, *rest = name.strip("/").split("/")
        head, _, tail = first.partition("_")
        return (head, tail, *rest) if tail and head in self._prefixes else (first, *rest)

    @cached_property
    def velocity_commands(self) -> list[TopicFacts]:
        """The topics by which drivers take velocities."""
        velocities = [topic for topic in self.velocities if self.drivers(topic) and self.crosses(topic)]
        return velocities[:MAX_COMMANDS]

    @cached_property
    def bases(self) -> list[TopicFacts]:
        return [topic for topic in self.velocity_commands if not self._moves_an_arm(topic)]

    @cached_property
    def arm_velocities(self) -> list[TopicFacts]:
        return [topic for topic in self.velocity_commands if self._moves_an_arm(topic)]

    @cached_property
    def arms(self) -> list[TopicFacts]:
        topics = [topic for topic in self.topics if topic.type in TRAJECTORIES and self.crosses(topic)]
        return [topic for topic in topics if topic not in self.legs][:MAX_COMMANDS]

    @cached_property
    def legs(self) -> list[TopicFacts]:
        """The trajectories by which a driver of a base carries out a velocity."""
        drivers = frozenset(node for base in self.bases for node in self.drivers(base))
        return [
            topic
            for topic in self.topics
            if topic.type in TRAJECTORIES and topic.publishers and drivers.issuperset(topic.publishers)
        ]

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
        driving = frozenset(node for node in nodes if self._commands_of.get(node, set()) <= {command.name})
        if len(nodes) > 1:  # a filter of positions may also use the commands
            driving -= self._filters
        return driving

    @cached_property
    def _commands_of(self) -> Mapping[str, set[str]]:
        """The velocities that each node publishes for others, and does not carry out in its own process."""
        found = dict[str, set[str]]()
        for topic in self.velocities:
            used = _used(topic)
            for node in {*topic.publishers} - used if used else ():
                found.setdefault(node, set()).add(topic.name)
        return found

    def ends(self, command: TopicFacts) -> frozenset[str]:
        """Return the nodes that carry out a command of any type."""
        return (self.drivers(command) if command.type in VELOCITIES else frozenset()) or _used(command)

    def crosses(self, command: TopicFacts) -> bool:
        """Whether the relay carries a command to a node: what a process sends to itself never leaves it."""
        return any(command.publishers != (node,) for node in self.ends(command))

    def robot_of(self, command: TopicFacts) -> GraphedRobot:
        return next(robot for robot in self.robots if command in robot.commands)

    def sources(self, command: TopicFacts, kinds: Iterable[str]) -> list[TopicFacts]:
        """Return the published topics of these types that belong to the command's robot."""
        wanted = {*kinds}
        return [
            topic
            for topic in self.topics
            if topic.type in wanted and topic.publishers and self.belongs(topic, command)
            and (not COMMAND.search(topic.name) or self.ends(command).issuperset(topic.publishers))
        ]  # fmt: skip

    def shared_topics(self, kinds: Iterable[str]) -> list[TopicFacts]:
        """Return the published topics of these types that are below no robot's namespace, and belong to none."""
        wanted, commands = {*kinds}, [robot.commands[0] for robot in self.robots]
        return [
            topic
            for topic in self.topics
            if topic.type in wanted and topic.publishers and not self.is_below(topic, self.robots)
            and not any(self.belongs(topic, command) for command in commands)
        ]  # fmt: skip

    def is_below(self, topic: TopicFacts, robots: Iterable[GraphedRobot]) -> bool:
        """Whether a topic is below the namespace of one of these robots."""
        place = self._parts(topic.name)
        return any(robot.namespace and place[: len(robot.namespace)] == robot.namespace for robot in robots)

    def leaf(self, topic: TopicFacts) -> str:
        """Return the last part of a name, without a prefix that stands for a namespace."""
        return self._parts(topic.name)[-1]

    def belongs(self, source: TopicFacts, command: TopicFacts) -> bool:
        own = self.robot_of(command)
        others = [robot for robot in self.robots if robot is not own]
        place = self._parts(source.name)
        inside = place[: len(own.namespace)] == own.namespace
        for other in others:
            below = bool(other.namespace) and place[: len(other.namespace)] == other.namespace
            if below and not (inside and len(own.namespace) > len(other.namespace)):
                return False
        if others:
            if inside and (own.namespace or all(other.namespace for other in others)):
                return True
            return _touches(source, own) and not any(_touches(source, other) for other in others)
        homes = {self._parts(node)[:-1][:1] for node in own.drivers}
        of_another = (
            {self._parts(node)[:-1][:1] for node in source.publishers} == {place[:1]}
            and len(place) > 1
            and not homes & {(), place[:1]}
        )
        return not of_another or _touches(source, own)

    def near(self, source: TopicFacts, command: TopicFacts) -> int:
        """Return how many levels of the namespace two topics share."""
        ours, theirs = self._parts(source.name), self._parts(command.name)
        pairs = zip(ours[:-1], theirs[:-1], strict=False)
        return next((level for level, (one, other) in enumerate(pairs) if one != other),
                    min(len(ours), len(theirs)) - 1)  # fmt: skip

    def origins(self, topic: TopicFacts, kinds: Collection[str]) -> list[TopicFacts]:
        """Return the topics of these types from which the topic's nodes may make it."""
        return [
            other for other in self.topics
            if other.name != topic.name and other.type in kinds and other.publishers
            and not {*topic.publishers}.isdisjoint(other.subscribers)
        ]  # fmt: skip

    def derived_from(self, topic: TopicFacts, others: Iterable[TopicFacts]) -> bool:
        """Whether a node makes the topic from one of the others: a filter, or a merger of scans."""
        return any(
            other.name != topic.name and not {*topic.publishers}.isdisjoint(other.subscribers)
            for other in others
        )

    def publishes(self, node: str, kinds: Iterable[str]) -> bool:
        wanted = {*kinds}
        return any(topic.type in wanted and node in topic.publishers for topic in self.topics)

    def unguarded_topics(self, kinds: Collection[str]) -> list[TopicFacts]:
        """Return topics that no preset works with: with both ends and a command's name, or goals of a driver."""
        drivers = frozenset(node for robot in self.robots for node in robot.drivers)
        return [
            topic
            for topic in self.topics
            if topic.type not in kinds
            and not (topic.type in _MEASURED and drivers.issuperset(topic.publishers))
            and (
                (COMMAND.search(topic.name) and topic.publishers and _used(topic))
                or (topic.type.endswith("ActionGoal") and not drivers.isdisjoint(topic.subscribers))
            )
        ]

    @cached_property
    def _filters(self) -> frozenset[str]:
        """The nodes that publish positions from the odometry of others."""
        users = {
            node
            for topic in self.topics
            if topic.type == "nav_msgs/Odometry"
            for node in topic.subscribers
            if topic.publishers != (node,)
        }
        return frozenset(
            node for topic in self.topics if topic.type in POSES for node in topic.publishers if node in users
        )

    def _moves_an_arm(self, command: TopicFacts) -> bool:
        if _NOT_A_BASE.search(command.name):
            return True
        if command.name.endswith("/cmd_vel"):  # also of a base with legs
            return False
        drivers = self.drivers(command)
        measured = any(self.publishes(node, POSES) for node in drivers)
        return not measured and any(self.publishes(node, _JOINT_COMMANDS) for node in drivers)

    def _same_robot(self, facts: TopicFacts, other: TopicFacts) -> bool:
        ours, theirs = self._parts(facts.name)[:-1], self._parts(other.name)[:-1]
        if ours == theirs:
            return self._one_body(facts, other, ours)
        if self.ends(facts).isdisjoint(self.ends(other)):
            return facts not in self.bases and bool(theirs) and ours[: len(theirs)] == theirs
        apart = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), None)
        if apart is None:
            return True
        heads = ours[: apart + 1], theirs[: apart + 1]
        return not all(  # a simulator drives several robots
            any(topic.type in _MEASURED and topic.publishers and self._parts(topic.name)[: apart + 1] == head
                for topic in self.topics)
            for head in heads
        )  # fmt: skip

    def _one_body(self, one: TopicFacts, other: TopicFacts, namespace: Namespace) -> bool:
        """Whether two commands of one namespace have a common driver, or nothing says that they are of two robots."""
        bases = [base for base in self.bases if self._parts(base.name)[:-1] == namespace]
        apart = [
            base
            for base in bases
            if base is not one and not SIDE.search(base.name) and self.ends(one).isdisjoint(self.ends(base))
        ]
        return not apart or other not in apart or (one not in bases and len(apart) == 1 == len(bases))

    def _robot(self, group: list[TopicFacts], groups: list[list[TopicFacts]]) -> GraphedRobot:
        places = [self._parts(command.name)[:-1] for command in group]
        common = places[0]
        for place in places[1:]:
            same = next((i for i, (a, b) in enumerate(zip(common, place, strict=False)) if a != b), None)
            common = common[: min(len(common), len(place)) if same is None else same]
        others = [
            self._parts(command.name)[:-1] for other in groups if other is not group for command in other
        ]
        namespace = common if others else ()
        for length in range(1, len(common) + 1):
            if others and not any(place[:length] == common[:length] for place in others):
                namespace = common[:length]
                break
        drivers = frozenset(node for command in group for node in self.ends(command))
        chain = drivers.union(*(command.publishers for command in group))
        for _step in range(_MAX_STEPS):
            inputs = (topic for topic in self.velocities if not chain.isdisjoint(topic.subscribers))
            chain = chain.union(*(topic.publishers for topic in inputs))
        prefixed = len(namespace) == 1 and namespace[0] in self._prefixes
        return GraphedRobot(namespace, tuple(group), drivers, chain, prefixed)


def _is_read(topic: TopicFacts) -> bool:
    name, kind = topic.name, topic.type
    return kind in _READ or kind.endswith("Goal") or bool(COMMAND.search(name) or STOP.search(name))


def _by_host(topics: Iterable[TopicFacts], named: Collection[str]) -> Iterator[TopicFacts]:
    """Order topics by name, so that hosts alternate: the topics of one host crowd out none of another.

    A topic of several hosts counts for the one with the fewest.
    """
    ordered = sorted(topics)
    counts = Counter(host for topic in ordered for host in topic.hosts)
    near = {
        node for topic in ordered if topic.name in named for node in (*topic.publishers, *topic.subscribers)
    }
    turns, placed = Counter[tuple[int, str]](), list[tuple[int, int, TopicFacts]]()
    for topic in ordered:
        apart = topic.name not in named
        rank = apart + (apart and near.isdisjoint((*topic.publishers, *topic.subscribers)))
        host = min(topic.hosts, key=lambda one: (counts[one], one), default="")
        turns[rank, host] += 1
        placed.append((rank, turns[rank, host], topic))
    return (topic for _rank, _turn, topic in sorted(placed, key=lambda row: row[:2]))


def _used(topic: TopicFacts) -> frozenset[str]:
    return frozenset(node for node in topic.subscribers if not _OBSERVER.search(node))


def _touches(source: TopicFacts, robot: GraphedRobot) -> bool:
    return not robot.chain.isdisjoint((*source.publishers, *source.subscribers))
