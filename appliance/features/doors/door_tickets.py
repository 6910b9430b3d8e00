"""Tickets that open a door. A browser or Foxglove can be given nothing but a URL, so the ticket is part of it."""

from collections.abc import Collection

from appliance.base import clock
from appliance.base.actors import OPERATOR
from appliance.control.errors import SenselessError
from appliance.features.doors.door_rows import DoorTables, TicketRow
from appliance.signing.bearer_secrets import SecretForm, hash_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore

TICKET_FORM = SecretForm("", ".")
_MOST = 1000
TICKETS = EndKind("door ticket", dated=True)
LONGEST_SECONDS = 30 * 86_400.0


class DoorTickets:
    """All tickets that have not ended."""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        self._tables = DoorTables(store.database)
        self._ends = ends
        self._rows = {row.id: row for row in self._tables.tickets()}
        ends.when_due(TICKETS, self._due)

    def valid(self, door: str | None = None) -> list[TicketRow]:
        """Return the tickets that have not ended, with their ends by the present system clock."""
        self._due([ticket for ticket in self._rows if self._ends.passed(TICKETS, ticket)])
        return [
            row._replace(expires=self._ends.date(TICKETS, row.id) or row.expires)
            for row in self._rows.values()
            if door in (None, row.door)
        ]

    def make(self, door: str, seconds: float, who: str) -> tuple[TicketRow, str]:
        """Return a new ticket and its text, which is stored nowhere."""
        if not 1 <= seconds <= LONGEST_SECONDS:
            raise SenselessError("a ticket is valid for one second to 30 days: write 8h or 7d")
        if len(self.valid()) >= _MOST:
            raise SenselessError(
                f"there are {_MOST} tickets, the limit: wait until some end, or remove a door (rosrv door remove NAME)"
            )
        row, text = new_ticket(door, seconds, who)
        self._rows[row.id] = row
        with self._tables.together():
            self._ends.set(TICKETS, row.id, seconds)
            self._tables.save_ticket(row)
        return row, text

    def find(self, door: str, text: str) -> TicketRow | None:
        row = TICKET_FORM.find(text, self._rows)
        return None if row is None or row.door != door or self._ends.passed(TICKETS, row.id) else row

    def ended(self, ticket: str) -> bool:
        return ticket not in self._rows or self._ends.passed(TICKETS, ticket)

    def forget(self, door: str) -> None:
        self._due([row.id for row in self.valid(door)])

    def _due(self, ended: list[str]) -> None:
        for ticket in ended:
            if self._rows.pop(ticket, None) is not None:
                self._tables.forget_ticket(ticket)
        self._ends.forget(TICKETS, *ended)


def new_ticket(door: str, seconds: float, who: str) -> tuple[TicketRow, str]:
    (ticket, secret, text), now = TICKET_FORM.make(), clock.wall()
    return TicketRow(ticket, door, hash_of(secret), now, now + seconds, who), text


def left_by_its_maker(row: TicketRow, bearers: Collection[str]) -> str:
    """Return a warning if the maker of a ticket is none of the `bearers`, the names of usable tokens and sessions.

    The ticket stays valid: an operator starts a dashboard, and signs out before it ends.
    """
    if row.who in bearers or row.who == OPERATOR:
        return ""
    return f"{row.who} has no token or session any longer; rosrv door remove {row.door} ends this ticket"
