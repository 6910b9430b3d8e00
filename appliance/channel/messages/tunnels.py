"""Messages about tunnels: control -> supervisor over the lifeline, and control <-> the process that runs charon."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.messages.message import Message

Esp = Literal["kernel", "user space"]
Fingerprint = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
"""SHA-256 of a public key (SubjectPublicKeyInfo in DER), in hexadecimal."""

APPLIANCE_NAME = "rosrv-appliance"  # the name in the appliance's own certificate; no host may have this name


class TunnelsWanted(Message):
    """Control asks the supervisor for tunnels.

    From now on, addresses of `pool` are accepted only through IPsec, the appliance has `address` (in `pool`), and the
    process that runs charon is started.
    """

    pool: str
    address: str


class TunnelsEnclosed(Message):
    """The supervisor answers `TunnelsWanted`: the firewall is in force, and where ESP runs. Otherwise, see `reason`."""

    esp: Esp | None
    reason: str = ""


class CertificateNeeded(Message):
    """The charon process asks for a certificate for the appliance's own key, with a signing request (PEM).

    `key` is the fingerprint of the key.
    """

    request: bytes
    key: Fingerprint


class CharonStarted(Message):
    """charon is running with this version. `key_exchange` lists the methods that it may offer, best first."""

    version: str
    key_exchange: list[str]


class TunnelHost(msgspec.Struct, frozen=True):
    """A host that may open a tunnel: its name, its virtual address, and the serial number of its certificate."""

    name: str
    address: str
    serial: str


class TunnelsStated(Message):
    """Control sends the data that charon needs: certificates, the revocation list (PEM), and the permitted hosts."""

    number: int
    esp: Esp
    address: str
    authority: bytes
    certificate: bytes
    revocations: bytes
    hosts: list[TunnelHost]


class TunnelChanged(Message):
    """The tunnel between a host at this real address and the appliance went up or down."""

    name: str
    up: bool
    remote: str


class TunnelRefused(Message):
    """The host at this real address was refused: its request for a tunnel, or, if not 0, this number of `packets`.

    The source address of a tunnel's packet is not verified.
    """

    remote: str
    reason: str
    packets: int = 0


class TunnelSeen(msgspec.Struct, frozen=True):
    """An established tunnel, its age in seconds, and its traffic in bytes as counted by the appliance."""

    name: str
    remote: str
    seconds: int
    bytes_in: int
    bytes_out: int


class TunnelsReported(Message):
    """The charon process lists all present tunnels. It has carried out the `TunnelsStated` with the number `taken`."""

    taken: int
    rows: list[TunnelSeen]


TunnelLink = (
    CertificateNeeded | CharonStarted | TunnelsStated | TunnelChanged | TunnelRefused | TunnelsReported
)  # fmt: skip
