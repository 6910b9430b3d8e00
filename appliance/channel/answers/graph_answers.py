"""The graph: who talks to whom, through the appliance or past it, and how much."""

from typing import Annotated, Any, Literal

import msgspec

from appliance.channel.answers.field_docs import NanoMoment, told


class Node(msgspec.Struct, frozen=True):
    """A node; `lost`: it does not answer, its registrations are kept back until it returns."""

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
    dropped: Annotated[int, told("messages that slow subscribers did not get")]
    messages_per_second: float
    bytes_per_second: float
    delay_seconds: Annotated[
        float, told("that the relay added to a message of the last second, on average; of services 0")
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


class TopicMessage(msgspec.Struct, frozen=True):
    """A message of a topic as subscribers get it, after the monitors."""

    time: Annotated[NanoMoment, told("when the relay passed it on, nanoseconds since the epoch")]
    node: Annotated[str, told("that published it")]
    size: Annotated[int, told("bytes, without those of its length")]
    fields: Annotated[
        dict[str, Any],
        told(
            "by name; what is left out of long values is counted (`… 344 more`), bytes are hexadecimal, NaN and"
            " infinity are strings"
        ),
    ]
    why: Annotated[str, told("why there are no fields but the first bytes; else empty")]


class TopicMessages(msgspec.Struct, frozen=True):
    """The next messages of a topic, fewer than asked for where no more came in time."""

    topic: str
    type: str
    publishers: list[str]
    subscribers: list[str]
    messages: list[TopicMessage]


class Registration(msgspec.Struct, frozen=True):
    """Something live that a call gave a host, as `appliance.policy.Live` has it."""

    host: str
    caller_id: str
    call: str
    resource: str
    namespace: bool = False


class Registrations(msgspec.Struct, frozen=True):
    """Everything live that a policy may end."""

    registrations: list[Registration]
