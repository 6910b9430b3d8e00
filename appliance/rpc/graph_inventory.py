"""Describe a surveyed graph, and what looks wrong in it. No I/O.

All names and texts come from the robot's nodes: any host that reached its master may have written them.
"""

from collections import Counter
from collections.abc import Iterator

import msgspec

MASTER_PORT = 11311
APPLIANCE = "a ROSRV appliance"
LISTENERS = {MASTER_PORT: "a ROS master", 9090: "rosbridge", 8765: "foxglove_bridge"}
"""Ports of programs that give the graph to any host."""

_MOVES = {"cmd", "vel", "command", "twist", "velocity", "joy", "goal", "setpoint", "trajectory"}
_ACTS = {
    "arm", "arming", "disarm", "trigger", "reset", "shutdown", "reboot", "enable", "disable", "power", "takeoff",
    "land", "set_mode",
}  # fmt: skip
_TELLING = ("password", "passwd", "passphrase", "secret", "token", "apikey", "credential", "privatekey")


_SHARED = "/rosout"  # each node publishes it
_LOOPBACK = ("http://localhost:", "http://127.")  # a name may be in /etc/hosts of the surveying machine only


class NodeConnection(msgspec.Struct, frozen=True):
    """A row of a node's `getBusInfo`. `peer` is a node or a URI, as the node says."""

    topic: str
    peer: str
    direction: str
    """`i`: the node receives, `o`: it sends, `b`: both."""
    transport: str
    connected: bool = True


class SurveyedNode(msgspec.Struct, frozen=True):
    """A node. `host` is the address of `uri`; empty if the name does not resolve."""

    name: str
    uri: str
    host: str = ""
    pid: int | None = None
    problem: str = ""
    """Why the node could not be asked; empty if it answered."""
    connections: tuple[NodeConnection, ...] = ()


class SurveyedTopic(msgspec.Struct, frozen=True):
    """A topic. `rate` is in messages a second by its publishers' own counts; None without a connection."""

    name: str
    type: str
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()
    rate: float | None = None


class SurveyedService(msgspec.Struct, frozen=True):
    """A service and the nodes that registered it."""

    name: str
    providers: tuple[str, ...]
    uri: str = ""


class OpenPort(msgspec.Struct, frozen=True):
    """A port that answered the surveying machine."""

    host: str
    port: int
    what: str


class GraphInventory(msgspec.Struct, frozen=True):
    """All that a survey has read."""

    master: str
    master_host: str
    nodes: tuple[SurveyedNode, ...] = ()
    topics: tuple[SurveyedTopic, ...] = ()
    services: tuple[SurveyedService, ...] = ()
    parameters: tuple[str, ...] = ()
    listeners: tuple[OpenPort, ...] = ()
    calls: int = 0
    seconds: float = 0
    left_out: tuple[str, ...] = ()
    """The parts that a limit of the survey left out, in words."""
    own: tuple[str, ...] = ()
    """All addresses of nodes on the machine of the master, if the survey ran on that machine."""
    protected: bool = False
    """Whether an appliance answers as the master: its policy decides what each host may do."""

    def host_of(self, node: str) -> str:
        return self.hosts.get(node, "")

    @property
    def hosts(self) -> dict[str, str]:
        """Return the address of each node."""
        return {node.name: node.host for node in self.nodes}

    def hosts_of(self, nodes: tuple[str, ...]) -> frozenset[str]:
        """Return an address of each machine of these nodes."""
        known = self.hosts
        found = {self.master_host if known.get(node) in self.own else known.get(node, "") for node in nodes}
        return frozenset(filter(None, found))


def _words(name: str) -> set[str]:
    return set(name.replace("_", "/").split("/")) | set(name.split("/"))


def moving_topics(inventory: GraphInventory) -> list[SurveyedTopic]:
    """Return the topics whose names are those of commands to a base or an arm, with a subscriber."""
    return [topic for topic in inventory.topics if topic.subscribers and _words(topic.name) & _MOVES]


def acting_services(inventory: GraphInventory) -> list[SurveyedService]:
    return [service for service in inventory.services if _words(service.name) & _ACTS]


def telling_parameters(inventory: GraphInventory) -> list[str]:
    """Return the parameters whose names are those of secrets. Their values are never read."""
    return [
        name
        for name in inventory.parameters
        if any(word in name.replace("_", "").lower() for word in _TELLING)
    ]


def problems(inventory: GraphInventory) -> Iterator[str]:
    """Yield a text for each fault that the graph shows."""
    for node in inventory.nodes:
        if node.problem:
            yield f"{node.name} cannot be asked: {node.problem}"
        elif node.uri.startswith(_LOOPBACK) and not inventory.master_host.startswith("127."):
            yield f"{node.name} announces {node.uri}, which no other host reaches: set ROS_IP or ROS_HOSTNAME for it"
    for topic in inventory.topics:
        if topic.name != _SHARED and len(hosts := inventory.hosts_of(topic.publishers)) > 1:
            yield f"{topic.name} has publishers on more than one host: {', '.join(sorted(hosts))}"
    for service in inventory.services:
        if len(service.providers) > 1:
            yield f"{service.name} has {len(service.providers)} providers; ROS calls the one that registered last"
    for (name, uri), number in Counter((node.name, node.uri) for node in inventory.nodes).items():
        if number > 1:
            yield f"{name} is listed more than once with {uri}"
    for node in inventory.nodes:
        udp = sorted({row.topic for row in node.connections if row.transport.upper() == "UDPROS"})
        if udp:
            yield (
                f"{node.name} uses UDPROS for {', '.join(udp)}, which the appliance refuses; a subscriber that"
                " also allows TCPROS then uses that"
            )


def exposure(inventory: GraphInventory) -> dict[str, int]:
    """Return in numbers what a host without any right in ROS may do today: everything."""
    return {
        "nodes that it can end": len(inventory.nodes),
        "topics that it can publish and read": len(inventory.topics),
        "of these, commands that move something": len(moving_topics(inventory)),
        "services that it can call or replace": len(inventory.services),
        "parameters that it can change": len(inventory.parameters),
    }
