"""The requests of operators' tools about doors, and the answers."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.answers.field_docs import Moment, doc
from appliance.channel.rest_bodies import WHOLE
from appliance.channel.rest_operation import Body, parameter, rest

LONGEST_SECONDS = 30 * 86_400
_NO_DOOR = {404: "There is no such door."}
DoorName = Annotated[
    str,
    parameter(
        "name of the door", name="door_name", pattern="^[a-z][a-z0-9_-]{0,30}$" + WHOLE, examples=["alice"]
    ),
]


class Ticket(msgspec.Struct, frozen=True):
    """A ticket that can be used now."""

    id: Annotated[str, doc("its name in records")]
    created: Moment
    expires: Moment
    who: Annotated[str, doc("who made it")]
    warning: Annotated[
        str,
        doc("that who made it has no token or session any longer, which does not end the ticket, or empty"),
    ] = ""


class ConnectedClient(msgspec.Struct, frozen=True, kw_only=True):
    """A connection to a door. The counts are of the last minute."""

    address: Annotated[str, doc("of the client")]
    since: Moment
    protocol: Annotated[str, doc("`rosbridge`, or the subprotocol of Foxglove")]
    ticket: Annotated[str, doc("id of its ticket, or empty if it came to an agent's port")]
    who: Annotated[str, doc("who made the ticket, or empty if there is no ticket, or it is over")]
    received: Annotated[int, doc("frames from the client")]
    sent: Annotated[int, doc("frames to the client")]
    refused: Annotated[int, doc("requests of the client that were refused")]


class DoorState(msgspec.Struct, frozen=True, kw_only=True):
    """The door of one identity. The policy names it `door:NAME`."""

    name: Annotated[str, doc("`door:NAME` in the policy")]
    address: Annotated[str, doc("its source address inside the appliance, as in records")]
    node: Annotated[str, doc("the name of its ROS node")]
    added: Moment
    port: Annotated[int | None, doc("the port of an agent, or null if only tickets open this door")]
    source: Annotated[str, doc("the address or network of the agent, or empty if any may connect")]
    trouble: Annotated[str, doc("why it does not serve, or empty if it serves")]
    warning: Annotated[
        str,
        doc(
            "why an agent may not reach its port, such as a port that two appliances lack at their fixed address,"
            " or empty"
        ),
    ]
    connections: Annotated[int, doc("at present")]
    received: Annotated[int, doc("frames from clients since the start of its process")]
    sent: Annotated[int, doc("frames to clients since the start of its process")]
    dropped: Annotated[int, doc("messages for clients that read too slowly")]
    refused: Annotated[int, doc("connections in excess of the limits")]
    tickets: Annotated[list[Ticket], doc("that can be used now")]
    clients: Annotated[list[ConnectedClient], doc("that are connected, oldest first, at most 50")]


class OwnDoor(msgspec.Struct, frozen=True, kw_only=True):
    """The door of the caller; a token's door has its name, a person's door the name of a group in `sso.doors`."""

    name: Annotated[str, doc("its name, even if it does not exist, or empty if the caller can have none")]
    door: Annotated[DoorState | None, doc("the caller's door, or null if there is none")]
    reason: Annotated[str, doc("why there is none, and what to do, or empty if there is one")]


class DoorList(msgspec.Struct, frozen=True):
    """All doors."""

    doors: Annotated[list[DoorState], doc("oldest first")]


class NewTicket(Ticket, frozen=True, kw_only=True):
    """A new ticket with its text, which is shown only here."""

    door: Annotated[str, doc("that it opens")]
    ticket: Annotated[str, doc("the secret; anyone who has it uses the door")]
    path: Annotated[str, doc("of the WebSocket at the REST port, with the ticket")]


@rest("viewer", "GET", "/v1/doors", name="doors")
class DoorsWanted(AdminRequest[DoorList], frozen=True, tag="doors"):
    """All doors, with their connections and valid tickets."""


@rest(
    "admin", "POST", "/v1/doors", name="add_door", status=201, good="The door was added.",
    body=Body(
        "NewDoor", "A door; an agent's door has a port, and may be limited to the agent's address or network."
    ),
)  # fmt: skip
class DoorAdd(WaitingRequest[DoorState], frozen=True, tag="door add"):
    """Add a door for one identity. Its rights are those of the host `door:NAME` in the policy."""

    name: Annotated[str, doc("its name", max_length=31)]
    port: Annotated[
        Annotated[int, msgspec.Meta(ge=1024, le=65_535)] | None,
        doc("port of an agent; without it, only tickets open the door"),
    ] = None
    source: Annotated[str, doc("address or network of the agent; by default, any", max_length=64)] = ""


@rest("admin", "DELETE", "/v1/doors/{door_name}", name="remove_door", problems=_NO_DOOR)
class DoorRemove(WaitingRequest[DoorState], frozen=True, tag="door remove"):
    """Remove a door: its connections and its tickets end. Its address stays reserved for its name."""

    name: DoorName


@rest(
    "operator", "POST", "/v1/doors/{door_name}/tickets", name="make_door_ticket", status=201,
    body=Body("TicketTime", "How long a ticket is valid."), good="The ticket was made.", problems=_NO_DOOR,
)  # fmt: skip
class DoorTicket(WaitingRequest[NewTicket], frozen=True, tag="door ticket"):
    """Make a ticket, with which a person's browser or viewer opens a door."""

    name: DoorName
    seconds: Annotated[float, doc("from now on", ge=1, le=LONGEST_SECONDS)]


@rest("viewer", "GET", "/v1/door", name="own_door", tag="doors")
class OwnDoorWanted(AdminRequest[OwnDoor], frozen=True, tag="own door"):
    """The door of the caller, which the console opens."""


@rest(
    "viewer", "POST", "/v1/door/tickets", name="make_own_ticket", tag="doors", status=201,
    good="The ticket was made.", problems={404: "The caller has no door."},
)  # fmt: skip
class DoorVisit(WaitingRequest[NewTicket], frozen=True, tag="door visit"):
    """Make a ticket for one connection to the caller's own door. The connection ends with the caller's token."""


REQUESTS = (DoorsWanted, DoorAdd, DoorRemove, DoorTicket, OwnDoorWanted, DoorVisit)
