"""The link between control and the process of a door.

A door's process has no network of its own. Control makes its sockets, with the address of its identity: so a
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
    """The door that the process serves, and the pages that may connect.

    Connections without a ticket of `tickets` end, because theirs may have expired without control.
    """

    name: str
    added: float
    address: str
    master_port: int
    origins: list[str]
    connections: int
    in_ten_seconds: int
    tickets: list[str]


class TypesGiven(Message, frozen=True):
    """The operator's definitions by `package/Type.msg` or `.srv`, at each change."""

    definitions: dict[str, str]


class PolicyChanged(Message, frozen=True):
    """Another policy is in force, which may allow what the earlier one denied."""


class DoorEnded(Message, frozen=True):
    """The door was removed, and its process ends."""


class AgentListener(Message, frozen=True):
    """The listening socket of the agent's port; only this address or network may connect."""

    descriptors: ClassVar[int] = 1
    source: str


class ViewerGiven(Message, frozen=True):
    """A person's connection, from the address `peer`, which showed this ticket."""

    descriptors: ClassVar[int] = 1
    peer: str
    ticket: str


class TicketEnded(Message, frozen=True):
    """The connections of a ticket end now."""

    ticket: str


class SocketWanted(Message, frozen=True):
    """The door asks for a connection, or for a listening socket (port 0)."""

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
    """Connections of one peer began or ended in the last second."""

    peer: str
    ticket: str
    began: int
    ended: int
    reason: str


class DoorCounted(Message, frozen=True):
    """The counts since the start of the process, except the present `connections`.

    `refused` counts connections, and `refusals` requests of clients.

    """

    connections: int = 0
    received: int = 0
    sent: int = 0
    dropped: int = 0
    refused: int = 0
    received_bytes: int = 0
    sent_bytes: int = 0
    refusals: int = 0


MOST_SHOWN = 50


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
    """The present connections, the oldest first."""

    clients: list[ClientShown]


DoorLink = (
    DoorStarted | DoorGiven | TypesGiven | PolicyChanged | DoorEnded | AgentListener | ViewerGiven | TicketEnded
    | SocketWanted | SocketGiven | SocketRefused | ConnectionsChanged | DoorCounted | ClientsShown
)  # fmt: skip


def node_name(name: str) -> str:
    return f"/door_{name.replace('-', '_')}"
