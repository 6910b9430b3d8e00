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
    """Answer to `TunnelsWanted`: the firewall is in force, and where ESP runs; otherwise `reason` says why not."""

    esp: Esp | None
    reason: str = ""


class CertificateNeeded(Message):
    """charon's process asks for a certificate for the appliance's own key, by a signing request (PEM)."""

    request: bytes


class CharonStarted(Message):
    """charon runs, in this version; `key_exchange` has the methods that it may offer, the best first."""

    version: str
    key_exchange: list[str]


class TunnelHost(msgspec.Struct, frozen=True):
    """A host that may come: its name, the virtual address kept for it, the serial of its certificate."""

    name: str
    address: str
    serial: str


class TunnelsStated(Message):
    """The data that charon needs: certificates and the list of revoked ones in PEM, the hosts that may come."""

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
    """A host at this real address asked for a tunnel and was refused; with `packets`, that many packets were.

    The source that a packet of a tunnel claims is not verified.
    """

    remote: str
    reason: str
    packets: int = 0


class TunnelSeen(msgspec.Struct, frozen=True):
    """An established tunnel, its age in seconds, and its bytes as the appliance counts them."""

    name: str
    remote: str
    seconds: int
    bytes_in: int
    bytes_out: int


class TunnelsReported(Message):
    """All present tunnels; charon has taken the statement with the number `taken`."""

    taken: int
    rows: list[TunnelSeen]


TunnelLink = (
    CertificateNeeded | CharonStarted | TunnelsStated | TunnelChanged | TunnelRefused | TunnelsReported
)  # fmt: skip
