"""The visits of signed-in people: the console opens the caller's own door, with a ticket for one connection.

Nothing is stored. A visit ends with control's process, and with the last of the tokens and sessions that its person
had. A person has at most `_MOST_OF_PERSON` visits; beyond them, a new visit replaces the oldest.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from appliance.features.doors.door_rows import TicketRow
from appliance.features.doors.door_tickets import TICKET_FORM, new_ticket
from appliance.store.ends import EndKind, EndTable

_OPEN_SECONDS = 60.0
VISITS = EndKind("door visit", stored=False)
"""Visits whose ticket is not used yet."""
_MOST_OF_PERSON = 8


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
        for visit in own[: max(0, len(own) + 1 - _MOST_OF_PERSON)]:
            visit.replaced = True
        row, text = new_ticket(door, seconds, who)
        credentials = frozenset(number for number, name in self._bearers().items() if name == who)
        self._visits[row.id] = _Visit(row, credentials)
        self._ends.set(VISITS, row.id, seconds)
        return row, text

    def find(self, door: str, text: str) -> TicketRow | None:
        row = TICKET_FORM.find(text, {one.row.id: one.row for one in self._visits.values()})
        return None if row is None or row.door != door or not self._may_open(self._visits[row.id]) else row

    def opened(self, ticket: str) -> None:
        self._visits[ticket].used = True
        self._ends.forget(VISITS, ticket)

    def left(self, door: str, ticket: str) -> None:
        visit = self._visits.get(ticket)
        if visit is not None and visit.row.door == door:
            del self._visits[ticket]

    def forget(self, door: str) -> None:
        self._visits = {ticket: one for ticket, one in self._visits.items() if one.row.door != door}

    def present(self, door: str) -> list[TicketRow]:
        return [one.row for one in self._visits.values() if one.row.door == door and not one.replaced]

    def ended(self) -> list[tuple[TicketRow, bool]]:
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
            and not self._ends.passed(VISITS, visit.row.id)
            and not visit.credentials.isdisjoint(self._bearers())
        )
