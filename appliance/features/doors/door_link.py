"""The messages between control and the process of a door.

A door's process has no network of its own. Control makes its sockets, bound to the address of its identity. So a
compromised door can use no other address, and reaches nothing but RVMaster, proxy endpoints and relays.
"""

from typing import ClassVar

import msgspec

from appliance.channel.messages.message import Message


class DoorStarted(Message, frozen=True):
    """The first message: the process's door (empty if unknown), and when it was added."""

    name: str
    added: float
    listens: bool


class DoorGiven(Message, frozen=True):
    """The door that the process serves, and the pages that may connect."""

    name: str
    added: float
    address: str
    master_port: int
    origins: list[str]
    connections: int
    in_ten_seconds: int
    tickets: list[str]
    """Connections with another ticket end, because it may have expired while control was down."""
    blocked: list[str]
    """The hosts that operators block."""


class TypesGiven(Message, frozen=True):
    """The operator's definitions changed. The keys are `package/Type.msg` and `package/Type.srv`."""

    definitions: dict[str, str]


class PolicyChanged(Message, frozen=True):
    """Rights changed, so that requests that were denied may be allowed: by a policy, an hour, an approval or a host."""


class BlocksGiven(Message, frozen=True):
    """All hosts that operators block, after a change."""

    hosts: list[str]


class DoorEnded(Message, frozen=True):
    """The door was removed, and its process ends."""


class AgentListener(Message, frozen=True):
    """The listening socket of the agent's port."""

    descriptors: ClassVar[int] = 1
    source: str
    """Only this address or network may connect, or any host if it is empty."""


class ViewerGiven(Message, frozen=True):
    """A connection from the address `peer`, opened with this ticket."""

    descriptors: ClassVar[int] = 1
    peer: str
    ticket: str


class TicketEnded(Message, frozen=True):
    """The ticket has ended, and its connections end with it."""

    ticket: str
    replaced: bool = False
    """Whether a newer visit of the same person took its place, so that the right has not ended."""


class SocketWanted(Message, frozen=True):
    """The door asks for a connection, or for a listening socket (port 0)."""

    number: int
    port: int


class SocketGiven(Message, frozen=True):
    """Control gives the socket of request `number`."""

    descriptors: ClassVar[int] = 1
    number: int


class SocketRefused(Message, frozen=True):
    """Control cannot provide the socket of request `number`."""

    number: int
    reason: str


MAX_NODES = 200
"""The most names in one `HostsWanted`."""


class HostsWanted(Message, frozen=True):
    """The door asks which of these nodes are on the same host."""

    number: int
    nodes: list[str]


class HostsGiven(Message, frozen=True):
    """A number for the host of each node of request `number`: 0 for the robot's machine, -1 for a node that is gone."""

    number: int
    hosts: list[int]


class DefinitionsDiffer(Message, frozen=True):
    """Two definitions of one type have one md5sum.

    Each publisher is a node and a topic; both are empty for the definition of ROS or the operator.
    """

    type: str
    md5sum: str
    earlier: tuple[str, str]
    later: tuple[str, str]


class ConnectionsChanged(Message, frozen=True):
    """Connections of one peer began, ended, or were refused before they began, in the last second."""

    peer: str
    ticket: str
    began: int
    ended: int
    refused: int
    reason: str


class DoorCounted(Message, frozen=True):
    """Counts since the start of the process."""

    connections: int = 0
    """The present number."""
    received: int = 0
    sent: int = 0
    dropped: int = 0
    refused: int = 0
    """Connections beyond the limits."""
    received_bytes: int = 0
    sent_bytes: int = 0
    refusals: int = 0
    """Refused requests of clients."""


MAX_SHOWN = 50


class ClientShown(msgspec.Struct, frozen=True):
    """A connection, with its counts of the last minute; `since` is seconds since the epoch."""

    peer: str
    ticket: str
    protocol: str
    since: float
    received: int
    sent: int
    refusals: int


class ClientsShown(Message, frozen=True):
    """The present connections, oldest first."""

    clients: list[ClientShown]


DoorLink = (
    DoorStarted | DoorGiven | TypesGiven | PolicyChanged | BlocksGiven | DoorEnded | AgentListener | ViewerGiven
    | TicketEnded | SocketWanted | SocketGiven | SocketRefused | HostsWanted | HostsGiven | ConnectionsChanged
    | DoorCounted | ClientsShown | DefinitionsDiffer
)  # fmt: skip


def node_name(name: str) -> str:
    return f"/door_{name.replace('-', '_')}"
