"""Define the requests of operators' tools about command authority, and their answers."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_operation import Body, parameter, rest
from appliance.features.authority.view import NotCarried

_NO_GROUP = {404: "The policy has no such group in [Authority].", 422: "The host may not."}
GroupName = Annotated[str, parameter("name of the group", min_length=1, max_length=64, examples=["base"])]


Host = Annotated[str, doc("address or name of a host", min_length=1, max_length=300)]
Seen = Annotated[
    Annotated[str, msgspec.Meta(max_length=300)] | None,
    doc(
        "address of the holder for whom the order is meant, or empty for none; refused if another one holds it"
    ),
]
_GROUP_HOST = Body("GroupHost", "The host that asks for a group.")


class GroupState(msgspec.Struct, frozen=True):
    """One group of `[Authority]`."""

    group: Annotated[str, doc("its name")]
    names: Annotated[list[str], doc("its topics and services")]
    holder: Annotated[str, doc("address of the host that holds it, or empty if none does")]
    held_seconds: Annotated[float | None, doc("how long the holder has had it, or null if no host holds it")]
    lease: Annotated[
        float, doc("seconds of silence after which a holder loses the group, or 0 if the group has a rank")
    ]
    left_seconds: Annotated[float | None, doc("until the holder loses the group by silence")]
    waiting: Annotated[list[str], doc("addresses of the hosts that asked for it, the first one first")]
    ranks: Annotated[
        list[str], doc("the hosts and nodes of each rank, the highest first; empty without a rank")
    ] = []
    driver: Annotated[str, doc("name of the node that moves it, or that fell silent after a motion")] = ""
    standing: Annotated[
        str,
        doc("of a group with a rank: `moving`, `free`, `lost` after a motion, or `unknown` after a start"),
    ] = ""
    why: Annotated[str, doc("why this node drives, or whom lower ranks wait for")] = ""
    not_carried: Annotated[
        list[NotCarried], doc("the hosts whose messages are not carried now, at most 20, by topic")
    ] = []


class GroupStates(msgspec.Struct, frozen=True):
    """All groups of `[Authority]`, by name."""

    groups: Annotated[list[GroupState], doc("by name")]


@rest("viewer", "GET", "/v1/drive", name="drive")
class DriveStatus(AdminRequest[GroupStates], frozen=True, tag="drive status"):
    """The holder of each group of topics and services, and the hosts that wait for it."""


@rest(
    "operator", "POST", "/v1/drive/{group}/assign", name="drive_assign", problems=_NO_GROUP,
    body=Body("GroupAssignment", "The host that takes a group."),
)  # fmt: skip
class DriveTake(WaitingRequest[GroupState], frozen=True, tag="drive take"):
    """Assign a group to a host that may take it, or that may override its holder."""

    group: GroupName
    host: Host
    holder: Seen = None


@rest(
    "operator", "POST", "/v1/drive/{group}/free", name="drive_free", problems=_NO_GROUP,
    body=Body("GroupGift", "The host that gets the group next, or empty for the first waiting host."),
)  # fmt: skip
class DriveGive(WaitingRequest[GroupState], frozen=True, tag="drive give"):
    """Take a group from its holder; it is assigned to a host, or to the first waiting host.

    In a group with ranks, all hosts may drive again, also after a driver was lost.
    """

    group: GroupName
    to: Annotated[str, doc("address or name of a host", max_length=300)] = ""
    holder: Seen = None


@rest(
    "operator", "POST", "/v1/drive/{group}/ask", name="drive_ask", body=_GROUP_HOST, problems=_NO_GROUP
)  # fmt: skip
class DriveAsk(WaitingRequest[GroupState], frozen=True, tag="drive ask"):
    """Let a host wait for a group. A host that may take the group gets it as soon as it is free."""

    group: GroupName
    host: Host


REQUESTS = (DriveStatus, DriveTake, DriveGive, DriveAsk)
