"""Tunnels: control -> supervisor over the lifeline, control <-> the process that runs charon."""

from typing import Literal

import msgspec

from appliance.channel.messages.message import Message

Esp = Literal["kernel", "user space"]
APPLIANCE_NAME = "rosrv-appliance"  # in the appliance's own certificate; no host may have it


class TunnelsWanted(Message):
    """Control asks the supervisor for tunnels: addresses of `pool` are accepted through IPsec only from now on,
    the appliance has `address` (in `pool`), and the process that runs charon is there.
    """

    pool: str
    address: str


class TunnelsEnclosed(Message):
    """Answer to `TunnelsWanted`: the firewall is in force and where ESP runs; else `reason` says why not."""

    esp: Esp | None
    reason: str = ""


class CertificateNeeded(Message):
    """charon's process asks for a certificate for the appliance's own key, by a signing request (PEM)."""

    request: bytes


class CharonStarted(Message):
    """charon runs, in this version; `key_exchange` are the methods that it is let offer, the best first."""

    version: str
    key_exchange: list[str]


class TunnelHost(msgspec.Struct, frozen=True):
    """A host that may come: its name, the virtual address kept for it, the serial of its certificate."""

    name: str
    address: str
    serial: str


class TunnelsStated(Message):
    """All that charon is to have: certificates and the list of revoked ones in PEM, the hosts that may come."""

    number: int
    esp: Esp
    address: str
    authority: bytes
    certificate: bytes
    revocations: bytes
    hosts: list[TunnelHost]


class TunnelChanged(Message):
    """The tunnel of a host came up from, or went down to, this real address."""

    name: str
    up: bool
    remote: str


class TunnelRefused(Message):
    """Somebody at this real address asked for a tunnel and was refused; with `packets`, that many packets were.

    What a packet of a tunnel claims to come from is no more than a claim.
    """

    remote: str
    reason: str
    packets: int = 0


class TunnelSeen(msgspec.Struct, frozen=True):
    """A tunnel that stands, for so many seconds; bytes as the appliance counts them."""

    name: str
    remote: str
    seconds: int
    bytes_in: int
    bytes_out: int


class TunnelsReported(Message):
    """All tunnels that stand now; charon has taken the statement with the number `taken`."""

    taken: int
    rows: list[TunnelSeen]


TunnelLink = (
    CertificateNeeded | CharonStarted | TunnelsStated | TunnelChanged | TunnelRefused | TunnelsReported
)  # fmt: skip
