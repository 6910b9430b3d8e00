"""Answers about hosts with tunnels, machines that connect unencrypted, and the results of changes."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, doc

PortsState = Literal["closed", "open", "unknown"]
State = Literal["up", "down", "expired", "revoked", "not wanted", "awaited", "not enrolled"]


class PortsSeen(msgspec.Struct, frozen=True):
    """Whether a machine's ROS ports are closed to all but the appliance, as probed from another host."""

    state: PortsState
    checked: Annotated[Moment | None, doc("null: never")]
    open: Annotated[list[int], doc("TCP ports that accepted a connection, the first hundred")]
    who: Annotated[str, doc("name of the token that reported it, or `operator`; empty: never checked")]


class Host(msgspec.Struct, frozen=True):
    """A host that connects through a tunnel; times are seconds since the epoch.

    `awaited`: it has a token and has not enrolled yet. `not wanted`: hosts.yaml says that its tunnel stays closed.
    """

    name: str
    address: Annotated[str | None, doc("its permanent virtual address")]
    state: State
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
    remote: Annotated[str | None, doc("its real address; null: no tunnel")]
    seconds: Annotated[int | None, doc("age of the SA")]
    bytes_in: int | None
    bytes_out: int | None
    last_seen: Annotated[Moment | None, doc("when a packet last arrived through its tunnel")]
    token_expires: Annotated[Moment | None, doc("when its one-time token expires; null: none")]
    ports: PortsSeen
    token_by: Annotated[str, doc("who made its one-time token; empty: it has no token")] = ""


class Machine(msgspec.Struct, frozen=True):
    """A machine that runs nodes and connects without a tunnel, identified by its address."""

    address: str
    nodes: int
    ports: PortsSeen


class Hosts(msgspec.Struct, frozen=True):
    """All hosts, and the state of the tunnels."""

    revision: Annotated[int, doc("the number in the ETag")]
    hosts: list[Host]
    machines: Annotated[list[Machine], doc("machines of nodes without a tunnel")]
    esp: Annotated[Literal["kernel", "user space"] | None, doc("where ESP runs; null: no tunnels are open")]
    key_exchange: Annotated[
        list[str], doc("key exchanges offered and accepted, the best first; empty: not known yet")
    ]
    post_quantum: Annotated[bool | None, doc("whether ML-KEM is among them; null: not known yet")]
    pool: str
    address: Annotated[str, doc("the appliance's own address in the tunnels")]
    hosts_file: str
    troubles: Annotated[list[str], doc("problems that need a person's attention")]


class BlockedHost(msgspec.Struct, frozen=True):
    """A host that an operator blocks."""

    address: str
    name: Annotated[str, doc("its name if it is enrolled, else empty")]
    since: Moment
    until: Annotated[Moment | None, doc("null: it ends by an order only")]
    who: Annotated[str, doc("name of the token, or `operator`")]
    note: str


class BlockedHosts(msgspec.Struct, frozen=True):
    """The blocked hosts, the earliest block first."""

    blocks: Annotated[list[BlockedHost], doc("the blocked hosts")]


class BlockEnded(msgspec.Struct, frozen=True):
    """The registrations and the connections through the relay that a block ended."""

    publications: Annotated[int, doc("registered topics that its nodes publish")]
    subscriptions: Annotated[int, doc("registered topics to which its nodes subscribe")]
    services: Annotated[int, doc("registered services of its nodes")]
    parameters: Annotated[int, doc("subscriptions to parameters")]
    connections: Annotated[int, doc("connections through the relay, to or from the host")]


class HostBlocked(BlockedHost, frozen=True, kw_only=True):
    """A host was blocked."""

    ended: BlockEnded
    replaced: Annotated[BlockedHost | None, doc("its earlier block; null: it was not blocked")]
    other_addresses: Annotated[
        list[str],
        doc("further addresses of the same machine that have rights: of its tunnel, or outside it"),
    ]


class HostUnblocked(BlockedHost, frozen=True, kw_only=True):
    """The block of a host was lifted."""

    restored: Annotated[int, doc("registrations that the block had withdrawn and that returned")]


class KitParts(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of an enrolled host's kit, without its private key.

    `rest_url` is the URL of REST in the tunnel, and `pin` the pin of its server's key. If either is empty, the host
    cannot renew its certificate through REST. `rest_trouble` says why other machines cannot reach REST, else it is
    empty. `kept` contains the data that were stored with the one-time token. `second` is the address of the other
    appliance of two, else empty; `pin` then names the keys of both.
    """

    revision: int
    name: str
    address: str
    appliance: str
    master: str
    rest_url: str
    rest_trouble: str
    pin: str
    warning: str | None
    serial: str
    expires: Moment
    certificate: str
    authority: str
    second: str = ""
    kept: dict[str, str] = {}


class EnrolmentToken(msgspec.Struct, frozen=True, kw_only=True):
    """A one-time token: shown only once."""

    revision: Annotated[int, doc("revision of the table of hosts, the number in the ETag")]
    name: str
    address: Annotated[str, doc("the virtual address that is reserved for the host")]
    token: str
    expires: Moment
    endpoint: Annotated[str, doc("address or name at which the host reaches the appliance")]
    endpoint_reason: Annotated[str, doc("why this endpoint was chosen if none was given; else empty")]
    url: Annotated[str, doc("URL where the host presents the token (POST /v1/enrol)")]
    pin: Annotated[str, doc("pin of that server's key, as curl's --pinnedpubkey takes it")]
    authority: Annotated[str, doc("SHA-256 of the authority's certificate, in hexadecimal")]
    script: Annotated[str, doc("join.sh: makes the key on the host, enrols it, starts and checks the tunnel")]


class Renewed(msgspec.Struct, frozen=True):
    """A host has put its new certificate in place."""

    name: str


class NewCertificate(msgspec.Struct, frozen=True):
    """The certificate for the new key; the previous one stays valid until `renewed` is called."""

    name: str
    serial: str
    expires: Moment
    certificate: str
    authority: str


class Revoked(msgspec.Struct, frozen=True):
    """A host was excluded permanently; `serial` is empty if the host had a token but never enrolled."""

    revision: int
    name: str
    address: str
    serial: str
    taken_back: Annotated[int, doc("revoked registrations and grants")]


class PortsReport(msgspec.Struct, frozen=True):
    """The stored result of the port check of `name`, a host's name or an address."""

    revision: int
    name: str
    ports: PortsSeen


class Reloaded(msgspec.Struct, frozen=True):
    """hosts.yaml was read again."""

    revision: int
    declared: list[str]
    opened: Annotated[list[str], doc("hosts whose tunnel is allowed again")]
    closed: Annotated[list[str], doc("hosts whose tunnel is no longer allowed")]
    divergence: list[str]


class Endpoint(msgspec.Struct, frozen=True):
    """The address at which hosts reach the appliance, and why it was chosen."""

    endpoint: str
    reason: str


class RevocationList(msgspec.Struct, frozen=True):
    """The authority's signed list of revoked certificates, in PEM."""

    revocations: str


class AuthorityCertificate(msgspec.Struct, frozen=True):
    """The authority's certificate, in PEM."""

    authority: str
