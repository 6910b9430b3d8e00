"""The link between control and the process of a door.

A door's process has no network of its own. Control makes its sockets, with the address of its identity: so a
compromised door can use no other address, and reaches nothing but RVMaster, proxy endpoints and relays.
"""

from typing import ClassVar

from appliance.channel.messages.message import Message


class DoorStarted(Message, frozen=True):
    """The first message of a process on each link: its door (empty: not known yet), and what it got from earlier links.

    `added` is the time of the door. `tickets` are those of its connections that have not ended.
    """

    name: str
    added: float
    listens: bool
    tickets: list[str]


class DoorGiven(Message, frozen=True):
    """Control names the door that the process serves, or changes the pages that may connect."""

    name: str
    added: float
    address: str
    master_port: int
    origins: list[str]
    connections: int
    in_ten_seconds: int


class TypesGiven(Message, frozen=True):
    """Control gives the operator's definitions by `package/Type.msg` or `.srv`, before `DoorGiven` and at each change."""

    definitions: dict[str, str]


class DoorEnded(Message, frozen=True):
    """The door was removed, and its process ends."""


class AgentListener(Message, frozen=True):
    """Control gives the listening socket of the agent's port; only this address or network may connect (empty: any)."""

    descriptors: ClassVar[int] = 1
    source: str


class ViewerGiven(Message, frozen=True):
    """Control gives a person's connection, from the address `peer`, which showed this ticket."""

    descriptors: ClassVar[int] = 1
    peer: str
    ticket: str


class TicketEnded(Message, frozen=True):
    """The connections of a ticket end now."""

    ticket: str


class SocketWanted(Message, frozen=True):
    """The door asks for a connection to a port of the appliance, or for a listening socket (port 0)."""

    number: int
    port: int


class SocketGiven(Message, frozen=True):
    """Control gives the socket of request `number`."""

    descriptors: ClassVar[int] = 1
    number: int


class SocketRefused(Message, frozen=True):
    """Control has no socket for request `number`, for this reason."""

    number: int
    reason: str


class ConnectionsChanged(Message, frozen=True):
    """Connections of one peer began or ended in the last second; `reason` is that of the last end."""

    peer: str
    ticket: str
    began: int
    ended: int
    reason: str


class DoorCounted(Message, frozen=True):
    """The counts of the process since its start, once a second when they have changed; `connections` is the present."""

    connections: int
    received: int
    sent: int
    dropped: int
    refused: int


DoorLink = (
    DoorStarted | DoorGiven | TypesGiven | DoorEnded | AgentListener | ViewerGiven | TicketEnded | SocketWanted | SocketGiven
    | SocketRefused | ConnectionsChanged | DoorCounted
)  # fmt: skip


def node_name(name: str) -> str:
    """Return the name of the door's ROS node."""
    return f"/door_{name.replace('-', '_')}"
