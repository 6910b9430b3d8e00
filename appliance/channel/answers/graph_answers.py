"""The graph: the connections between nodes, whether through the appliance or not, and their traffic."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Address, Name, RosType, doc


class Node(msgspec.Struct, frozen=True):
    """A node; `lost`: it does not answer, and its registrations return when it does."""

    name: Name
    host: Address
    state: Annotated[Literal["live", "lost"], doc("its state")]
    publishes: Annotated[list[str], doc("topics that it publishes")]
    subscribes: Annotated[list[str], doc("topics that it subscribes to")]
    offers: Annotated[list[str], doc("services that it offers")]
    uncallable: Annotated[
        bool, doc("whether it cannot be called, as behind NAT: it hears of no publisher that comes later")
    ] = False


class Flow(msgspec.Struct, frozen=True, kw_only=True):
    """The traffic since RVMaster started, and the present traffic (a second's average)."""

    messages: Annotated[int, doc("messages relayed since counting began")]
    bytes: Annotated[int, doc("bytes of its messages, since counting began")]
    dropped: Annotated[int, doc("messages dropped for slow subscribers")]
    messages_per_second: Annotated[float, doc("average of the last second")]
    bytes_per_second: Annotated[float, doc("average of the last second")]
    delay_seconds: Annotated[
        float, doc("average delay that the relay added to the messages of the last second; 0 for services")
    ]


class Publisher(Flow, frozen=True, kw_only=True):
    """A publisher of a topic, with what came from it."""

    node: Name


class Connection(msgspec.Struct, frozen=True):
    """A subscriber or client that is connected through the appliance to a node."""

    from_: Annotated[str, doc("the node that publishes or offers it")] = msgspec.field(name="from")
    to: Annotated[str, doc("the name given by the connected peer: a claim")]
    host: Annotated[str, doc("address of the connected peer")]


class Topic(msgspec.Struct, frozen=True):
    """A topic; `mediated`: its messages go through the appliance."""

    name: Name
    type: RosType
    mediated: Annotated[bool, doc("whether its messages go through the appliance")]
    publishers: Annotated[list[Publisher], doc("nodes that publish it")]
    subscribers: Annotated[list[str], doc("nodes that subscribe to it")]
    connections: Annotated[list[Connection], doc("open connections through the appliance")]


class Service(Flow, frozen=True, kw_only=True):
    """A service and the node that offers it."""

    name: Name
    node: Name
    mediated: Annotated[bool, doc("whether its messages go through the appliance")]
    connections: Annotated[list[Connection], doc("open connections through the appliance")]


class Graph(msgspec.Struct, frozen=True):
    """The graph at one moment, without the appliance's own nodes."""

    nodes: Annotated[list[Node], doc("nodes that run or are expected back")]
    topics: Annotated[list[Topic], doc("topics that a node publishes or subscribes to")]
    services: Annotated[list[Service], doc("services that a node offers")]


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
