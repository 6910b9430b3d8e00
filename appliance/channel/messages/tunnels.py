"""Messages about tunnels: control -> supervisor over the lifeline, and control <-> the process that runs charon."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.messages.message import Message

Esp = Literal["kernel", "user space"]
Fingerprint = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
"""SHA-256 of a SubjectPublicKeyInfo in DER, in hexadecimal."""

APPLIANCE_NAME = "rosrv-appliance"  # the name in the appliance's own certificate; no host may have this name


class TunnelsWanted(Message):
    """Control asks for tunnels.

    From now on, addresses of `pool` are accepted only through IPsec, and the process that runs charon is started.
    """

    pool: str
    address: str


class TunnelsEnclosed(Message):
    """The firewall is in force and ESP runs, or `reason` is the cause of the failure."""

    esp: Esp | None
    reason: str = ""


class CertificateNeeded(Message):
    """A signing request (PEM) for the appliance's own key."""

    request: bytes
    key: Fingerprint


class CharonStarted(Message):
    """Charon runs; `key_exchange` lists the methods that it may offer, best first."""

    version: str
    key_exchange: list[str]


class TunnelHost(msgspec.Struct, frozen=True):
    """A host that may open a tunnel; `address` is its address in the tunnel."""

    name: str
    address: str
    serial: str


class TunnelsStated(Message):
    """All data that charon needs; certificates and the revocation list are PEM."""

    number: int
    esp: Esp
    address: str
    authority: bytes
    certificate: bytes
    revocations: bytes
    hosts: list[TunnelHost]


class TunnelChanged(Message):
    """A tunnel opened or closed; `remote` is the real address of the host."""

    name: str
    up: bool
    remote: str


class TunnelRefused(Message):
    """A request for a tunnel was refused or, if `packets` is not 0, that number of packets in a tunnel.

    The source address of a tunnel's packet is not verified. `remote` is empty for requests of many others.
    """

    remote: str
    reason: str
    packets: int = 0


class TunnelSeen(msgspec.Struct, frozen=True):
    """An established tunnel; bytes are counted by the appliance."""

    name: str
    remote: str
    seconds: int
    bytes_in: int
    bytes_out: int


class TunnelsReported(Message):
    """All present tunnels, once the `TunnelsStated` with the number `taken` is carried out."""

    taken: int
    rows: list[TunnelSeen]


TunnelLink = (
    CertificateNeeded | CharonStarted | TunnelsStated | TunnelChanged | TunnelRefused | TunnelsReported
)  # fmt: skip
