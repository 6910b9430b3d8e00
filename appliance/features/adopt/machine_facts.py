"""Describe the machine of an adoption, as the supervisor sees it."""

import ipaddress
import re
from contextlib import suppress

import msgspec

from appliance.features.adopt.adopt_record import AdoptRecord, Phase
from roswire.uris import NodeUri

FIRST_PORT = 1024
"""The first port that is cut: smaller ones belong to the machine, whatever a node says."""

STAND_IN_UNIT = "rosrv-left-master"
_TRANSIENT = re.compile(rf"{STAND_IN_UNIT}\.service|run-[ru]?[0-9a-f]{{1,40}}\.service")
"""Units without a file, of which a release or `systemd-run` makes another one each time, as a login of scopes."""


class RobotMaster(msgspec.Struct, frozen=True):
    """The program that listens on the port of the robot's own master. `group` is set if its unit has nothing else."""

    pid: int
    program: str
    user: str
    unit: str = ""
    group: str = ""

    def __str__(self) -> str:
        return f"{self.program} ({self.unit or f'user {self.user}'})"


class MachineFacts(msgspec.Struct, frozen=True):
    """The machine. `link` and `appliance` are the addresses of the link's ends.

    By the port of a node's API on this machine, `reaches` has the address by which its process reaches its master, and
    `sockets` all ports on which that process listens.
    """

    record: AdoptRecord
    link: str
    appliance: str
    own: list[str] = []
    master: RobotMaster | None = None
    reaches: dict[int, str] = {}
    sockets: dict[int, list[int]] = {}
    resolved: dict[str, list[str]] = {}

    @property
    def foreign_master(self) -> str:
        """Why the present master is not the recorded one; empty if it is, or if one of the two is missing."""
        found, record = self.master, self.record
        adopted = record.wanted or record.phase is not Phase.FREE
        if found is None or not adopted or not record.program or found.pid == record.stand_in:
            return ""
        lasts = record.unit and not record.unit.endswith(".scope") and not _TRANSIENT.fullmatch(record.unit)
        same = found.unit == record.unit if lasts else found.program == record.program
        if same and found.user == record.user:
            return ""
        recorded = f"{record.program} ({record.unit or 'no unit'}, user {record.user})"
        return f"{found.program} ({found.unit or 'no unit'}, user {found.user}) is not the recorded master {recorded}"

    def is_here(self, address: str) -> bool:
        return ipaddress.ip_address(address).is_loopback or address in self.own

    def has_node(self, uri: NodeUri) -> bool:
        """Return whether a process of this machine listens at a node's URI."""
        known = self.resolved.get(uri.host, [])
        with suppress(ValueError):
            known = [str(ipaddress.ip_address(uri.host))]
        return uri.port in self.sockets and any(map(self.is_here, known))
