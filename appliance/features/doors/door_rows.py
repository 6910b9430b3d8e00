"""Store doors, identities with their addresses, and the tickets of people; `store/state_file.py` has their tables."""

from typing import NamedTuple

from appliance.store.writer_thread import Database


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
