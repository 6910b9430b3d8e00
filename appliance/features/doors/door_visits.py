"""The visits of signed-in people: the console opens the caller's own door, with a ticket for one connection.

Nothing is stored. A visit ends with control's process, and with the last of the tokens and sessions that its person
had. A person has at most `_MAX_OF_PERSON` visits; beyond them, a new visit replaces the oldest.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from appliance.base import clock
from appliance.base.actors import OPERATOR
from appliance.control.errors import SenselessError
from appliance.features.doors.door_table import DoorTables, TicketRow
from appliance.signing.bearer_secrets import SecretForm, hash_of
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore

# Tickets that open a door. A browser or Foxglove can be given nothing but a URL, so the ticket is part of it.

TICKET_FORM = SecretForm("", ".")
_MAX = 1000
TICKETS = EndKind("door ticket", dated=True)


class DoorTickets:
    """All tickets that have not ended."""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        self._tables = DoorTables(store.database)
        self._ends = ends
        self._rows = {row.id: row for row in self._tables.tickets()}
        ends.when_due(TICKETS, self._due)

    def valid(self, door: str | None = None) -> list[TicketRow]:
        """Return the tickets that have not ended, with their ends by the present system clock."""
        self._due([ticket for ticket in self._rows if self._ends.is_over(TICKETS, ticket)])
        return [
            row._replace(expires=self._ends.date(TICKETS, row.id) or row.expires)
            for row in self._rows.values()
            if door in (None, row.door)
        ]

    def make(self, door: str, seconds: float, who: str) -> tuple[TicketRow, str]:
        """Return a new ticket and its text, which is stored nowhere."""
        if len(self.valid()) >= _MAX:
            raise SenselessError(
                f"there are {_MAX} tickets, the limit: wait until some end, or remove a door (rosrv door remove NAME)"
            )
        row, text = new_ticket(door, seconds, who)
        self._rows[row.id] = row
        with self._tables.together():
            self._ends.set(TICKETS, row.id, seconds)
            self._tables.save_ticket(row)
        return row, text

    def find(self, door: str, text: str) -> TicketRow | None:
        row = TICKET_FORM.find(text, self._rows)
        return None if row is None or row.door != door or self._ends.is_over(TICKETS, row.id) else row

    def has_ended(self, ticket: str) -> bool:
        return ticket not in self._rows or self._ends.is_over(TICKETS, ticket)

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


_OPEN_SECONDS = 60.0
VISITS = EndKind("door visit", stored=False)
"""Visits whose ticket is not used yet."""
_MAX_OF_PERSON = 8


@dataclass(slots=True)
class _Visit:
    row: TicketRow
    credentials: frozenset[str]
    used: bool = False
    replaced: bool = False


class DoorVisits:
    """All visits. `bearers()` returns the names of the usable tokens and sessions by their ids."""

    def __init__(self, ends: EndTable, bearers: Callable[[], Mapping[str, str]]) -> None:
        self._ends = ends
        self._bearers = bearers
        self._visits: dict[str, _Visit] = {}

    def make(self, door: str, who: str, seconds: float = _OPEN_SECONDS) -> tuple[TicketRow, str]:
        own = [one for one in self._visits.values() if one.row.who == who and not one.replaced]
        for visit in own[: max(0, len(own) + 1 - _MAX_OF_PERSON)]:
            visit.replaced = True
        row, text = new_ticket(door, seconds, who)
        credentials = frozenset(number for number, name in self._bearers().items() if name == who)
        self._visits[row.id] = _Visit(row, credentials)
        self._ends.set(VISITS, row.id, seconds)
        return row, text

    def find(self, door: str, text: str) -> TicketRow | None:
        row = TICKET_FORM.find(text, {visit.row.id: visit.row for visit in self._visits.values()})
        return None if row is None or row.door != door or not self._may_open(self._visits[row.id]) else row

    def opened(self, ticket: str) -> None:
        self._visits[ticket].used = True
        self._ends.forget(VISITS, ticket)

    def left(self, door: str, ticket: str) -> None:
        visit = self._visits.get(ticket)
        if visit is not None and visit.row.door == door:
            del self._visits[ticket]

    def forget(self, door: str) -> None:
        self._visits = {ticket: visit for ticket, visit in self._visits.items() if visit.row.door != door}

    def present(self, door: str) -> list[TicketRow]:
        return [visit.row for visit in self._visits.values() if visit.row.door == door and not visit.replaced]

    def pop_ended(self) -> list[tuple[TicketRow, bool]]:
        """Remove and return the visits that have ended, and whether a newer one replaced them."""
        if not self._visits:
            return []
        bearers = self._bearers()
        ended = [
            one
            for one in self._visits.values()
            if one.replaced
            or one.credentials.isdisjoint(bearers)
            or (not one.used and not self._may_open(one))
        ]
        for visit in ended:
            del self._visits[visit.row.id]
            self._ends.forget(VISITS, visit.row.id)
        return [(visit.row, visit.replaced) for visit in ended]

    def _may_open(self, visit: _Visit) -> bool:
        return (
            not visit.used
            and not visit.replaced
            and not self._ends.is_over(VISITS, visit.row.id)
            and not visit.credentials.isdisjoint(self._bearers())
        )
