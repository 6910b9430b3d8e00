"""Wait until a robot stands still: before its protection is changed, a person wants to see that it does not move.

1. A robot stands if its last command was zero, and, where it measures its own speed, that was zero too, both for some
   seconds. All commands and all odometry count.
2. Silence is not standing: without a commanded zero, or while odometry is silent, the robot is not known to stand.
3. The wait has an end, with a reason.
4. Motions that no such topic reports are not seen: an arm, a base with other messages, and without odometry the real
   speed. The answer names it.
"""

import asyncio
import functools
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.cli.connection.admin_client import AdminSocket
from appliance.cli.connection.target import Appliance
from appliance.cli.durations import bounded_span
from appliance.cli.output import usage_error
from appliance.network.interfaces import addresses_by_interface
from appliance.network.namespaces import Namespace
from appliance.rpc.master_reader import PUBLICATION, SUBSCRIPTION, MasterGraph, MasterReader, MasterReadError
from rosmop.tool.terminal import printable, refused, say
from roswire.definitions import Definitions
from roswire.errors import RosError
from roswire.message_view import read_fields
from roswire.node.network import SourceNetwork
from roswire.node.ros_node import RosNode
from roswire.node.tcpros_streams import NodeLimits
from roswire.node.topics import Received
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from roswire.uris import parse_node_uri

STILL_SECONDS = 3.0
_NAME = "/rosrv_standing"
_LINK = "veth-rosrv"
_SPEED = 0.01  # m/s, rad/s
_LOOK_SECONDS = 0.2
_MOST = 16  # topics of each kind
_SHOWN = 3
WITHIN = 120.0
"""The seconds that a verb waits unless the operator says otherwise."""
_COMMANDS: Mapping[str, tuple[str, ...]] = {
    "geometry_msgs/Twist": (),
    "geometry_msgs/TwistStamped": ("twist",),
}
_ODOMETRY: Mapping[str, tuple[str, ...]] = {"nav_msgs/Odometry": ("twist", "twist")}
"""The fields above the twist, by the type of the topic."""
_OTHER_COMMANDS = ("ackermann_msgs/", "control_msgs/", "mavros_msgs/", "std_msgs/Float64", "trajectory_msgs/")
"""The beginnings of types that command a motion in a way that is not read here."""

WhenStanding = Annotated[
    bool,
    typer.Option(
        "--when-standing",
        help="On the appliance's machine: change nothing until the robot stands still, by its velocity commands and its"
        " odometry",
    ),
]


def _seconds(given: str | float) -> float:
    """Return the seconds of --within; typer also converts the default."""
    return given if isinstance(given, float) else bounded_span("--within", given, "1s", "1h", bare="s")


def longest_wait(end: str) -> object:
    """Return the option --within, in seconds, with the default `WITHIN`."""
    return typer.Option(
        "--within",
        parser=_seconds,
        metavar="DURATION",
        show_default=False,
        help=f"The longest wait {end}, 1s to 1h (default: 2m)",
    )


Within = Annotated[float, longest_wait("of --when-standing")]


class NotStandingError(Exception):
    """The robot did not stop before the end of the wait, or its topics cannot be heard; the message says why."""


@dataclass
class StandingJudge:
    """Decides whether a robot stands, by the speeds that its topics say. Times are in seconds of one clock."""

    commands: frozenset[str]
    odometry: frozenset[str]
    seconds: float = STILL_SECONDS
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

    def why_not(self, now: float) -> str:
        """Return why the robot is not known to stand; empty if it stands."""
        if not self.commands:
            return "no topic commands a base (geometry_msgs/Twist)"
        for topic in sorted((self.commands | self.odometry) & self._moved.keys()):
            if topic not in self._still_since:
                return f"{topic} says that it moves"
        commanded = [topic for topic in self.commands if topic in self._still_since]
        if not commanded:
            return f"no zero was commanded on {', '.join(sorted(self.commands))}"
        for topic in sorted(self.odometry):
            if now - self._heard.get(topic, -math.inf) > self.seconds:
                return f"{topic} is silent"
        still = max(self._still_since[topic] for topic in {*commanded, *self.odometry})
        left = self.seconds - (now - still)
        return f"it stands for less than {self.seconds:g} s" if left > 0 else ""


def stand_or_exit(appliance: Appliance, within: float, verb: str) -> None:
    """Wait until this machine's robot stands still, and print the evidence. Exit with status 1 if it does not."""
    if not isinstance(appliance.way, AdminSocket):
        raise usage_error(
            "--when-standing listens to the robot's topics: run it on the appliance's machine", verb
        )
    try:
        master, source = _master_of(appliance.way.state)
        said = asyncio.run(wait_until_standing(master, within, source))
    except NotStandingError as error:
        raise refused([printable(f"{verb}: {error}. Nothing was changed")]) from None
    if not appliance.as_json:
        say(printable(said))


def _master_of(state: Path) -> tuple[str, str]:
    """Return the URI of RVMaster, and an address of this machine that the robot's nodes reach."""
    from appliance.configuration.settings import load_resolved  # noqa: PLC0415  pydantic, in each verb with --when-standing

    try:
        settings = load_resolved(state / "run" / "config.json")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise NotStandingError(
            f"no appliance has run in {state} ({why}): name its state directory with --state"
        ) from None
    return f"http://127.0.0.1:{settings.listen_address[1]}", link_address() or "127.0.0.1"


def link_address() -> str:
    """Return the machine's address on the appliance's link; empty while no appliance with such a link runs."""
    held = addresses_by_interface(Namespace.own()).get(_LINK, [])
    return next((text.partition("/")[0] for text in held if "." in text), "")


async def wait_until_standing(master: str, longest: float, source: str = "127.0.0.1") -> str:
    """Wait until the robot at this master stands; return the signs of it, and what is not seen.

    Raises `NotStandingError`, at the latest after `longest` s.
    `source` is an address of this machine that the robot's nodes reach.
    """
    try:
        graph = await MasterReader(parse_node_uri(master)).read()
    except (MasterReadError, RosError) as error:
        raise NotStandingError(f"the topics at {master} cannot be read: {error}") from None
    commands = _topics(graph, _COMMANDS, SUBSCRIPTION)
    odometry = _topics(graph, _ODOMETRY, PUBLICATION)
    judge = StandingJudge(frozenset(commands), frozenset(odometry))
    node = RosNode(_NAME, master, SourceNetwork(source), limits=NodeLimits(), shut_down=lambda _reason: None)
    await node.start()
    try:
        for topic in (*commands, *odometry):
            await node.subscribe(topic, _listener(judge, topic, graph.types[topic]))
        until = clock.now() + longest
        while why := judge.why_not(clock.now()):
            if clock.now() > until or not commands:
                raise NotStandingError(f"the robot is not known to stand still: {why}")
            await asyncio.sleep(_LOOK_SECONDS)
    except RosError as error:
        raise NotStandingError(f"the topics cannot be heard: {error}") from None
    finally:
        await node.close()
    seen = f" and {counted(len(odometry), 'odometry topic')}" if odometry else ""
    stands = f"the robot stands still: zero for {judge.seconds:g} s on {', '.join(commands)}{seen}"
    return f"{stands}. Not seen: {unseen(graph)}"


def unseen(graph: MasterGraph) -> str:
    """Return in words what the topics of a graph do not tell about motions."""
    parts = (
        []
        if _topics(graph, _ODOMETRY, PUBLICATION)
        else ["the real speed, because no node publishes odometry"]
    )
    used = {resource for kind, resource, _name in graph.entries if kind == SUBSCRIPTION}
    others = sorted(topic for topic in used if graph.types.get(topic, "").startswith(_OTHER_COMMANDS))
    if others:
        more = f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else ""
        parts.append(f"what {', '.join(others[:_SHOWN])}{more} may move")
    parts.append("motions that no topic commands")
    return "; ".join(parts)


def _topics(graph: MasterGraph, kinds: Collection[str], end: str) -> list[str]:
    used = {resource for kind, resource, _name in graph.entries if kind == end}
    found = sorted(topic for topic in used if graph.types.get(topic) in kinds)
    if len(found) > _MOST:
        raise NotStandingError(
            f"{counted(len(found), 'topic')} of a base are more than can be heard ({_MOST})"
        )
    return found


def _listener(judge: StandingJudge, topic: str, kind: str) -> Received:
    path = _COMMANDS.get(kind, _ODOMETRY.get(kind, ()))

    def heard(data: Body, _header: Mapping[str, str]) -> None:
        judge.hear(topic, speed_in(kind, path, bytes(data)), clock.now())

    return heard


def speed_in(kind: str, path: Iterable[str], data: bytes) -> float:
    """Return the largest component of a message's twist; infinity for a message that cannot be read."""
    fields: object = read_fields(_definitions(), kind, data)
    for name in path:
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
