"""The requests about blocked hosts, and their answers."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest
from appliance.channel.answers.field_docs import Moment, RevisionNote, VirtualAddress, doc
from appliance.channel.rest_bodies import Note
from appliance.channel.rest_operation import Body, parameter, rest

LONGEST_BLOCK_SECONDS = 365 * 86_400


class BlockedHost(msgspec.Struct, frozen=True):
    """A host that an operator blocks."""

    address: VirtualAddress
    name: Annotated[str, doc("its name if it is enrolled, else empty")]
    since: Moment
    until: Annotated[Moment | None, doc("when it ends, or null if only by an order")]
    who: Annotated[str, doc("name of the token, or `operator`")]
    note: RevisionNote


class BlockedHosts(msgspec.Struct, frozen=True):
    """The blocked hosts, earliest block first."""

    blocks: Annotated[list[BlockedHost], doc("the blocked hosts")]


class BlockEnded(msgspec.Struct, frozen=True):
    """The registrations, connections and further uses that a block ended."""

    publications: Annotated[int, doc("registered topics that its nodes publish")]
    subscriptions: Annotated[int, doc("registered topics to which its nodes subscribe")]
    services: Annotated[int, doc("registered services of its nodes")]
    parameters: Annotated[int, doc("subscriptions to parameters")]
    connections: Annotated[int, doc("connections through the relay, to or from the host")]
    uses: Annotated[
        list[str], doc("sessions, followers, connections to doors and the tunnel of the host, in words")
    ] = []


class HostBlocked(BlockedHost, frozen=True, kw_only=True):
    """A host was blocked, or would be in a dry run."""

    ended: BlockEnded
    replaced: Annotated[BlockedHost | None, doc("its earlier block, or null if it was not blocked")]
    other_addresses: Annotated[
        list[str],
        doc("further addresses of the same machine that have rights: of its tunnel, or outside it"),
    ]


class HostUnblocked(BlockedHost, frozen=True, kw_only=True):
    """The block of a host was lifted."""

    restored: Annotated[int, doc("registrations that the block had withdrawn and that returned")]


@rest(
    "operator", "POST", "/v1/blocks", name="block_host", body=Body("NewBlock", "A host to block."), tag="hosts",
    problems={422: "The address cannot be blocked, or only with `force`."},
)  # fmt: skip
class HostBlock(AdminRequest[HostBlocked], frozen=True, tag="host block"):
    """Block a host at every entrance, and end its registrations, connections, sessions and tunnel, for `for_seconds`,
    or until `DELETE`.

    The block of a host that is already blocked is replaced. The same block, without an end, changes nothing.
    """

    address: Annotated[
        str, doc("an IPv4 or IPv6 address, or the name of an enrolled host", min_length=1, max_length=64)
    ]
    for_seconds: Annotated[
        Annotated[float, msgspec.Meta(ge=1, le=LONGEST_BLOCK_SECONDS)] | None,
        doc("the block ends after this time; by default, only by an order"),
    ] = None
    note: Annotated[Note, doc("reason for the block, shown to operators")] = ""
    force: Annotated[bool, doc("block the robot's own host, or the caller's own, also")] = False
    dry_run: Annotated[bool, doc("only answer what the block would end")] = False


@rest(
    "operator", "DELETE", "/v1/blocks/{address}", name="unblock_host", tag="hosts",
    problems={404: "This host is not blocked."},
)  # fmt: skip
class HostUnblock(AdminRequest[HostUnblocked], frozen=True, tag="host unblock"):
    """Lift the block of a host: the policy decides its requests again, and its withdrawn registrations return."""

    address: Annotated[
        str, parameter("address or name of the host", min_length=1, max_length=64, examples=["10.0.0.7"])
    ]


@rest("viewer", "GET", "/v1/blocks", name="host_blocks", tag="hosts")
class HostBlocks(AdminRequest[BlockedHosts], frozen=True, tag="host blocks"):
    """The hosts that operators block, earliest block first."""


REQUESTS = (HostBlock, HostUnblock, HostBlocks)
