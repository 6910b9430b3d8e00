"""The table of doors: identities, their addresses and processes.

1. A name keeps its address for good, even after its door was removed, because records name hosts by address.
2. The policy gets a door's address only if the firewall reserves it. Otherwise another host or program could use it.
   An address outside of `doors.network` is never reserved.
"""

import ipaddress
import itertools
import re
from collections.abc import Mapping
from typing import NamedTuple

from appliance.base import clock
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.doors.door_link import node_name
from appliance.features.doors.settings import MAX_DOORS, Doors
from appliance.policy.model import DOOR, Address, address_of
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import Database

# Store doors, identities with their addresses, and the tickets of people; `store/state_file.py` has their tables.


class DoorRow(NamedTuple):
    """The door of one identity; times are seconds since the epoch.

    A name always keeps its address, even after its removal. `slot` is the number of its process. `port` is the port
    of an agent (None: only tickets), and `source` its address or network (empty: any).
    """

    name: str
    address: str
    added: float
    removed: float | None
    slot: int | None
    port: int | None
    source: str


class TicketRow(NamedTuple):
    """A ticket for a door, without its secret; times are seconds since the epoch, and `expires` is for people."""

    id: str
    door: str
    hash: bytes
    created: float
    expires: float
    who: str


class DoorTables:
    """The rows of doors and tickets in the state file."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self.together = database.together

    def save(self, row: DoorRow) -> None:
        self._database.put("door", *row)

    def doors(self) -> list[DoorRow]:
        return [DoorRow(*row) for row in self._database.query("SELECT * FROM door ORDER BY added, name")]

    def save_ticket(self, row: TicketRow) -> None:
        self._database.put("door_ticket", *row)

    def forget_ticket(self, ticket: str) -> None:
        self._database.delete("door_ticket", id=ticket)

    def tickets(self) -> list[TicketRow]:
        return [
            TicketRow(*row) for row in self._database.query("SELECT * FROM door_ticket ORDER BY created, id")
        ]


_NAME = re.compile(r"[a-z][a-z0-9_-]{0,30}", re.ASCII)
_MAX_NAMES = 2000  # including removed ones


class DoorTable:
    """All doors that were ever added."""

    def __init__(self, store: StateStore, settings: Doors) -> None:
        self._tables = DoorTables(store.database)
        self._network = ipaddress.IPv4Network(settings.network)
        self._gateway = settings.gateway
        self._rows = {row.name: row for row in self._tables.doors()}
        # Why the firewall does not reserve the addresses, or empty.
        self.closed = "the firewall does not reserve doors.network yet"

    @property
    def problem(self) -> str:
        return self.stray or self.closed

    @property
    def stray(self) -> str:
        stray = next((row for row in self.live() if not self._has(row.address)), None)
        if stray is None:
            return ""
        return (
            f"door {stray.name} has the address {stray.address}, outside of doors.network {self._network}:"
            " set the earlier network, or remove the door"
        )

    def _has(self, address: str) -> bool:
        return address_of(address) in self._network and address != self._gateway

    def live(self) -> list[DoorRow]:
        return [row for row in self._rows.values() if row.removed is None]

    def ports(self) -> list[int]:
        return [row.port for row in self.live() if row.port is not None]

    def addresses(self) -> Mapping[str, Address]:
        return {} if self.problem else {f"{DOOR}{row.name}": address_of(row.address) for row in self.live()}

    def of(self, name: str) -> DoorRow:
        row = self._rows.get(name)
        if row is None or row.removed is not None:
            known = ", ".join(row.name for row in self.live()[:20])
            others = f"the doors are: {known}" if known else "add it: rosrv door add NAME"
            raise UnknownThingError(f"there is no door {name[:80]!r}; {others}")
        return row

    def in_slot(self, slot: int) -> DoorRow | None:
        return next((row for row in self.live() if row.slot == slot), None)

    def plan(self, name: str, port: int | None, source: str) -> DoorRow:
        self._require_name(name)
        if source and port is None:
            raise SenselessError("--from needs --port: only agents are known by their address")
        taken = next((row for row in self.live() if port is not None and row.port == port), None)
        if taken is not None:
            raise SenselessError(f"port {port} is the port of the door {taken.name}: choose another one")
        slots = {row.slot for row in self.live()}
        slot = next((number for number in range(MAX_DOORS) if number not in slots), None)
        if slot is None:
            raise SenselessError(
                f"there are {MAX_DOORS} doors, the limit: remove one (rosrv door remove NAME)"
            )
        earlier = self._rows.get(name)
        address = earlier.address if earlier is not None else self._free_address()
        if not self._has(address):
            raise SenselessError(
                f"{name} keeps its earlier address {address}, outside of doors.network {self._network}: choose another"
                " name, or set the earlier network"
            )
        return DoorRow(name, address, clock.wall(), None, slot, port, _network(source) if source else "")

    def _require_name(self, name: str) -> None:
        if not _NAME.fullmatch(name):
            raise SenselessError(
                f"{name[:80]!r} is not a name of a door: at most 31 of a-z, 0-9, _ and -, a letter first"
            )
        if name in self._rows and self._rows[name].removed is None:
            raise SenselessError(f"there is a door {name} already: choose another name, or remove it first")
        twin = next((row for row in self._rows if row != name and node_name(row) == node_name(name)), None)
        if twin is not None:
            raise SenselessError(
                f"{name} differs from {twin} only in - and _, which is the same name in ROS: choose another name"
            )
        if name not in self._rows and len(self._rows) >= _MAX_NAMES:
            raise SenselessError(
                f"{_MAX_NAMES} names of doors were used, the limit: use an earlier name again"
            )

    def _free_address(self) -> str:
        taken = {row.address for row in self._rows.values()} | {self._gateway}
        for candidate in itertools.islice(self._network.hosts(), _MAX_NAMES + 2):
            if str(candidate) not in taken:
                return str(candidate)
        raise SenselessError(f"no address of {self._network} is free: set a larger doors.network")

    def save(self, row: DoorRow) -> None:
        self._rows.pop(row.name, None)
        self._rows[row.name] = row
        self._tables.save(row)

    def remove(self, name: str) -> DoorRow:
        row = self.of(name)
        self.save(row._replace(removed=clock.wall(), slot=None))
        return row


def is_door_name(text: str) -> bool:
    return _NAME.fullmatch(text) is not None


def _network(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text))
    except ValueError as error:
        raise SenselessError(f"--from: {text[:80]!r} is not an address or network: {error}") from None
