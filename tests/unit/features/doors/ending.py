from appliance.features.doors.door_visits import TICKETS, VISITS, DoorTickets, DoorVisits
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings


def ticket(store: StateStore, ends: EndTable) -> Ending:
    tickets = DoorTickets(store, ends)
    return Ending(lambda seconds: tickets.make("alice", seconds, "ann"), lambda: bool(tickets.valid("alice")))


def visit(_store: StateStore, ends: EndTable) -> Ending:
    visits, secrets = DoorVisits(ends, lambda: {"1": "ann"}), [""]

    def begin(seconds: float) -> None:
        secrets.append(visits.make("alice", "ann", seconds)[1])

    return Ending(begin, lambda: visits.find("alice", secrets[-1]) is not None)


ENDINGS: Endings = {TICKETS: ticket, VISITS: visit}
