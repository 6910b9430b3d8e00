"""Propose guards for the topics of a running robot."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.features.guards import message_types as types
from appliance.features.guards.message_types import TypeRow

_COMMAND = re.compile(r"cmd|command|setpoint|drive|ackermann", re.IGNORECASE)
_STOP = re.compile(r"e_?stop|emergency|protective_stop", re.IGNORECASE)
_POSITION_FIRST = re.compile(r"odom|local_position/pose|amcl_pose", re.IGNORECASE)
_WORLD_FRAME = re.compile(r"/mavros/setpoint_velocity/")  # MAVROS takes them in the local frame by default
_SCAN_OF_A_CAMERA = re.compile(r"camera|depth", re.IGNORECASE)


class TopicFacts(NamedTuple):
    """A topic with its type, the nodes at both ends, and its messages per second."""

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rate: float = 0.0


@dataclass(frozen=True)
class Proposal:
    """A guard that fits the graph."""

    preset: str
    name: str
    topics: Mapping[str, str]
    measured: Mapping[str, str] = field(default_factory=dict)
    """The values that come from present rates; `values` has the others that fit the topics."""
    values: Mapping[str, str] = field(default_factory=dict)

    @property
    def command(self) -> str:
        words = [f"rosrv guard new {self.preset} {self.topics['command']}"]
        words += [f"--by {topic}" if name == "by" else f"--topic {name}={topic}"
                  for name, topic in self.topics.items() if name != "command"]  # fmt: skip
        if self.name != self.preset:
            words.append(f"--name {self.name}")
        words += [
            "--shadow",
            *(f"{name}={value}" for name, value in {**self.measured, **self.values}.items()),
        ]
        return " ".join(words)


def proposals(graph: Iterable[TopicFacts]) -> list[Proposal]:
    """Return guards for all topics that command a base or an arm, in the order in which they act."""
    topics = list(graph)
    bases = [one for one in topics if one.type in types.VELOCITIES and _commands_a_base(one, topics)]
    arms = [one for one in topics if one.type in types.TRAJECTORIES and one.subscribers]
    alone = len(bases) + len(arms) == 1
    found = [one for base in bases for one in _for_a_base(base, topics, alone=alone)]
    return found + [one for arm in arms for one in _for_an_arm(arm, topics, alone=alone)]


def _commands_a_base(topic: TopicFacts, topics: Iterable[TopicFacts]) -> bool:
    passing = {
        node
        for one in topics
        if one.type in types.VELOCITIES and one.name != topic.name and _COMMAND.search(one.name)
        for node in one.publishers
    }
    return bool(_COMMAND.search(topic.name)) and not passing.issuperset(topic.subscribers)


def _for_a_base(base: TopicFacts, topics: list[TopicFacts], *, alone: bool) -> Iterator[Proposal]:
    def proposal(preset: str, measured: Mapping[str, str] | None = None, **further: str) -> Proposal:
        values = {"worldFrame": "true"} if preset == "fence" and _WORLD_FRAME.search(base.name) else {}
        return Proposal(
            preset, _name(preset, base, alone), {"command": base.name, **further}, measured or {}, values
        )

    yield proposal("deadman", _silence(base, 0.2, 2))
    for stop in (
        one for one in topics if one.type == "std_msgs/Bool" and _STOP.search(one.name) and one.publishers
    ):
        yield proposal("estop", stop=stop.name)
        break
    scans = _sources(base, topics, types.SCANS, avoid=_SCAN_OF_A_CAMERA)
    position = next(iter(_sources(base, topics, types.POSES, prefer=_POSITION_FIRST)), None)
    if position is not None:
        yield proposal("fence", _silence(position, 0.2, 5), by=position.name)
    if scans:
        yield proposal("sensor", _silence(scans[0], 0.1, 5), by=scans[0].name)
        yield proposal("separation", _silence(scans[0], 0.1, 5), by=scans[0].name)
    yield proposal("speed")
    for battery in _sources(base, topics, types.BATTERIES)[:1]:
        yield proposal("arm", _silence(battery, 5, 600), by=battery.name)


def _for_an_arm(arm: TopicFacts, topics: list[TopicFacts], *, alone: bool) -> Iterator[Proposal]:
    yield Proposal("joints", _name("joints", arm, alone), {"command": arm.name})
    states = _sources(arm, topics, {"sensor_msgs/JointState": TypeRow()})
    if states:
        by = {"command": arm.name, "by": states[0].name}
        # A resting arm repeats its positions.
        yield Proposal(
            "sensor", _name("sensor", arm, alone), by, _silence(states[0], 0.1, 5), {"frozen": "0"}
        )
    if arm.type == types.GOAL and arm.name.endswith("/goal"):
        before = arm.name.removesuffix("/goal")
        if any(one.name == f"{before}/result" for one in topics):
            yield Proposal("answer", _name("answer", arm, alone), {"command": arm.name})


def _sources(
    command: TopicFacts,
    topics: Iterable[TopicFacts],
    rows: Mapping[str, TypeRow],
    prefer: "re.Pattern[str] | None" = None,
    avoid: "re.Pattern[str] | None" = None,
) -> list[TopicFacts]:
    """Return the topics with publishers and such a type. Topics near the command's namespace come first."""
    found = [one for one in topics if one.type in rows and one.publishers and not _COMMAND.search(one.name)]

    def order(one: TopicFacts) -> tuple[bool, bool, int, str]:
        preferred = prefer is None or bool(prefer.search(one.name))
        avoided = avoid is not None and bool(avoid.search(one.name))
        return (avoided, not preferred, -_shared(one.name, command.name), one.name)

    return sorted(found, key=order)


def _shared(one: str, other: str) -> int:
    pairs = zip(one.split("/")[:-1], other.split("/")[:-1], strict=False)
    return next(
        (place for place, (a, b) in enumerate(pairs) if a != b), min(one.count("/"), other.count("/"))
    )


def _silence(topic: TopicFacts, least: float, most: float) -> dict[str, str]:
    """Allow five periods of the present rate."""
    return {"silent": f"{min(max(5 / topic.rate, least), most):.3g}"} if topic.rate > 0 else {}


def _name(preset: str, topic: TopicFacts, alone: bool) -> str:
    return preset if alone else f"{preset}_{re.sub(r'[^a-z0-9]+', '_', topic.name.lower()).strip('_')[-50:]}"
