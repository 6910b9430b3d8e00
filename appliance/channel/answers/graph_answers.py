"""The graph: the connections between nodes, whether through the appliance or not, and their traffic."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import doc


class Node(msgspec.Struct, frozen=True):
    """A node; `lost`: it does not answer, and its registrations return when it does."""

    name: str
    host: str
    state: Literal["live", "lost"]
    publishes: list[str]
    subscribes: list[str]
    offers: list[str]


class Flow(msgspec.Struct, frozen=True, kw_only=True):
    """The traffic since RVMaster started, and the present traffic (a second's average)."""

    messages: int
    bytes: int
    dropped: Annotated[int, doc("messages dropped for slow subscribers")]
    messages_per_second: float
    bytes_per_second: float
    delay_seconds: Annotated[
        float, doc("average delay that the relay added to the messages of the last second; 0 for services")
    ]


class Publisher(Flow, frozen=True, kw_only=True):
    """A publisher of a topic, with what came from it."""

    node: str


class Connection(msgspec.Struct, frozen=True):
    """A subscriber or client that is connected through the appliance to a node."""

    from_: str = msgspec.field(name="from")
    to: str
    host: str


class Topic(msgspec.Struct, frozen=True):
    """A topic; `mediated`: its messages go through the appliance."""

    name: str
    type: str
    mediated: bool
    publishers: list[Publisher]
    subscribers: list[str]
    connections: list[Connection]


class Service(Flow, frozen=True, kw_only=True):
    """A service and the node that offers it."""

    name: str
    node: str
    mediated: bool
    connections: list[Connection]


class Graph(msgspec.Struct, frozen=True):
    """The graph at one moment, without the appliance's own nodes."""

    nodes: list[Node]
    topics: list[Topic]
    services: list[Service]


class Registration(msgspec.Struct, frozen=True):
    """A live right that a call gave a host (`LiveRight` in `appliance/policy/live_rights.py`)."""

    host: str
    caller_id: str
    call: str
    resource: str
    namespace: bool = False


class Registrations(msgspec.Struct, frozen=True):
    """Everything live that a policy may end."""

    registrations: list[Registration]
