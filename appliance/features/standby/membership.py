"""The file that makes an appliance one of two: names, addresses and keys. `rosrv standby join` writes it."""

import ipaddress
from pathlib import Path
from typing import Annotated

import msgspec

from appliance.base.atomic_files import write_whole

FOLDER = "standby"
FILE = "membership.json"
LEASE_FILE, LINK_FILE = "lease.json", "link.json"
"""The parts of the membership that the supervisor writes for the process `lease` and for control."""

LEASE_NICE = -10  # the niceness of the witness's unit
LEFT_FILE = "left.json"
"""The last membership that this appliance left, without its secrets."""

PORT = 7412
"""The default port of both appliances: promises (UDP) and replication (TCP)."""

_Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z][a-z0-9-]{0,31}\Z")]
_Key = Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64})?\Z")]
_Ports = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,5}(-[0-9]{1,5})?\Z")]
_Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]


class MembershipError(ValueError):
    """A membership that cannot be used; the message names the file and the reason."""


class Membership(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """This appliance, the other one, and the witness on the robot.

    A process gets only the secrets that it needs; the others are empty.
    """

    name: _Name
    other: _Name
    address: str
    """The IPv4 address of this appliance, as the robot and the other appliance see it."""
    other_address: str
    fixed: str
    """The address at which the robot's nodes reach the active appliance."""
    witness: str
    witness_port: _Port
    ports: tuple[_Ports, ...] = ()
    """The TCP ports and ranges at the fixed address; an earlier version did not store them."""
    port: _Port = PORT
    witness_key: _Key
    """Authenticates datagrams to the witness (hexadecimal)."""
    peer_key: _Key
    """Authenticates datagrams to the other appliance (hexadecimal)."""
    certificate: str
    key: str
    """The key of `certificate`, which is for the replication (PEM)."""
    other_certificate: str
    sealed_certificate: str = ""
    sealed_key: str = ""
    """With `sealed_certificate`, the tunnels' authority, encrypted with a passphrase. Only the other appliance's file
    has it.
    """

    def __post_init__(self) -> None:
        for text in (self.address, self.other_address, self.fixed, self.witness):
            address = ipaddress.IPv4Address(text)
            if address.is_unspecified or address.is_multicast or address.is_loopback:
                raise ValueError(f"{text} cannot be an address of the robot's network")
        if self.name == self.other or len({self.address, self.other_address, self.fixed, self.witness}) != 4:
            raise ValueError(
                "the two names must differ, and both appliances, the robot and the fixed address need an address each"
            )
        if self.witness_key and self.witness_key == self.peer_key:
            raise ValueError("the key of the witness and the key of the other appliance must differ")

    def without_secrets(self) -> "Membership":
        return msgspec.structs.replace(self, sealed_certificate="", sealed_key="")

    def port_ranges(self) -> tuple[range, ...] | None:
        """Return the TCP ports at the fixed address, or None if they are not known."""
        found = [[int(end) for end in text.split("-")] for text in self.ports]
        return tuple(range(ends[0], ends[-1] + 1) for ends in found) or None

    def for_lease(self) -> "Membership":
        return msgspec.structs.replace(self, certificate="", key="", other_certificate="")

    def for_control(self) -> "Membership":
        return msgspec.structs.replace(self, witness_key="", peer_key="")


def path_of(state: Path) -> Path:
    return state / FOLDER / FILE


def load_membership(path: Path) -> Membership | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Membership)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise MembershipError(
            f"{path} cannot be used: {error}; run `rosrv standby join` again, or `rosrv standby leave`"
        ) from error


def save_membership(path: Path, membership: Membership, owner: tuple[int, int] | None = None) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_whole(path, encode(membership), 0o600, owner)


def encode(membership: Membership) -> bytes:
    return msgspec.json.format(msgspec.json.encode(membership))
