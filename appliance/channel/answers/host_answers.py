"""Answers about hosts with tunnels, machines that connect unencrypted, and the results of changes."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, Name, doc

PortsState = Literal["closed", "open", "unknown"]
State = Literal["up", "down", "expired", "revoked", "not wanted", "awaited", "not enrolled"]


class PortsSeen(msgspec.Struct, frozen=True):
    """Whether a machine's ROS ports are closed to all but the appliance, as probed from another host."""

    state: Annotated[PortsState, doc("its state")]
    checked: Annotated[Moment | None, doc("when its ports were last checked, or null if never")]
    open: Annotated[list[int], doc("TCP ports that accepted a connection, the first hundred")]
    who: Annotated[str, doc("name of the token that reported it, or `operator`, or empty if never checked")]


class Host(msgspec.Struct, frozen=True):
    """A host that connects through a tunnel; times are seconds since the epoch.

    `awaited`: it has a token and has not enrolled yet. `not wanted`: hosts.yaml says that its tunnel stays closed.
    """

    name: Name
    address: Annotated[str | None, doc("its permanent virtual address")]
    state: Annotated[State, doc("its state")]
    groups: Annotated[list[str], doc("its groups in hosts.yaml")]
    declared: Annotated[bool, doc("it is in hosts.yaml")]
    wanted: Annotated[bool, doc("hosts.yaml allows its tunnel, or does not list the host")]
    divergence: Annotated[str | None, doc("the difference from hosts.yaml, in a sentence")]
    serial: Annotated[str | None, doc("serial number of its certificate, in hexadecimal")]
    enrolled: Moment | None
    expires: Annotated[Moment | None, doc("the end of its certificate")]
    expires_soon: Annotated[bool, doc("within 14 days, or a third of its life if that is shorter")]
    renewing: Annotated[bool, doc("it has a newer certificate that it has not installed yet")]
    revoked: Moment | None
    remote: Annotated[str | None, doc("its real address, or null if it has no tunnel")]
    seconds: Annotated[int | None, doc("age of the SA")]
    bytes_in: Annotated[int | None, doc("bytes received over the current SA")]
    bytes_out: Annotated[int | None, doc("bytes sent over the current SA")]
    last_seen: Annotated[Moment | None, doc("when a packet last arrived through its tunnel")]
    token_expires: Annotated[Moment | None, doc("when its one-time token expires, or null if it has none")]
    ports: PortsSeen
    token_by: Annotated[str, doc("who made its one-time token, or empty if it has none")] = ""
