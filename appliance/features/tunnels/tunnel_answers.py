"""Define the answers about hosts in tunnels: lists, kits, one-time tokens, and the results of changes."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, Name, RevisionNumber, VirtualAddress, doc
from appliance.channel.answers.host_answers import Host, PortsSeen


class Machine(msgspec.Struct, frozen=True):
    """A machine that runs nodes and connects without a tunnel, identified by its address."""

    address: VirtualAddress
    nodes: Annotated[int, doc("number of nodes that run on it")]
    ports: PortsSeen


class Hosts(msgspec.Struct, frozen=True):
    """All hosts, and the state of the tunnels."""

    revision: Annotated[int, doc("the number in the ETag")]
    hosts: Annotated[list[Host], doc("enrolled, awaited or declared")]
    machines: Annotated[list[Machine], doc("machines of nodes without a tunnel")]
    esp: Annotated[
        Literal["kernel", "user space"] | None, doc("where ESP runs, or null if no tunnels are open")
    ]
    key_exchange: Annotated[
        list[str], doc("key exchanges offered and accepted, best first, or empty if not known yet")
    ]
    post_quantum: Annotated[bool | None, doc("whether ML-KEM is among them, or null if not known yet")]
    pool: Annotated[str, doc("network of the virtual addresses")]
    address: Annotated[str, doc("the appliance's own address in the tunnels")]
    hosts_file: Annotated[str, doc("path of hosts.yaml")]
    troubles: Annotated[list[str], doc("problems that need a person's attention")]


class KitParts(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of an enrolled host's kit, without its private key.

    Without `rest_url` and `pin`, the host cannot renew its certificate through REST. `rest_trouble` is why other
    machines cannot reach REST. `kept` has the data that were stored with the one-time token. `second` is the
    address of the other appliance of two; `pin` then names the keys of both.
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
    """A one-time token, which is shown only once."""

    revision: Annotated[int, doc("revision of the table of hosts, the number in the ETag")]
    name: Name
    address: Annotated[str, doc("the virtual address that is reserved for the host")]
    token: Annotated[str, doc("the one-time token")]
    expires: Moment
    endpoint: Annotated[str, doc("address or name at which the host reaches the appliance")]
    endpoint_reason: Annotated[str, doc("why this endpoint was chosen if none was given; else empty")]
    url: Annotated[str, doc("URL where the host presents the token (POST /v1/enrol)")]
    pin: Annotated[str, doc("pin of that server's key, as curl's --pinnedpubkey takes it")]
    authority: Annotated[str, doc("SHA-256 of the authority's certificate, in hexadecimal")]
    script: Annotated[str, doc("join.sh: makes the key on the host, enrols it, starts and checks the tunnel")]


class Renewed(msgspec.Struct, frozen=True):
    """A host has installed its new certificate."""

    name: str


class NewCertificate(msgspec.Struct, frozen=True):
    """The certificate for the new key; the previous one stays valid until `renewed` is called."""

    name: Name
    serial: Annotated[str, doc("serial number of its certificate, in hexadecimal, or empty without one")]
    expires: Moment
    certificate: Annotated[str, doc("the certificate, in PEM")]
    authority: Annotated[str, doc("certificate of the hosts' authority, in PEM")]


class Revoked(msgspec.Struct, frozen=True):
    """A host was excluded permanently; `serial` is empty if the host had a token but never enrolled."""

    revision: RevisionNumber
    name: Name
    address: VirtualAddress
    serial: Annotated[str, doc("serial number of its certificate, in hexadecimal, or empty without one")]
    taken_back: Annotated[int, doc("revoked registrations and grants")]


class PortsReport(msgspec.Struct, frozen=True):
    """The stored result of the port check of `name`, a host's name or an address."""

    ports: PortsSeen
    revision: int = 0
    name: str = ""


class Reloaded(msgspec.Struct, frozen=True):
    """hosts.yaml was read again."""

    revision: RevisionNumber
    declared: Annotated[list[str], doc("names in hosts.yaml")]
    opened: Annotated[list[str], doc("hosts whose tunnel is allowed again")]
    closed: Annotated[list[str], doc("hosts whose tunnel is no longer allowed")]
    divergence: Annotated[list[str], doc("differences between hosts.yaml and the enrolled hosts")]


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
