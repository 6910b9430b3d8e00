from appliance.features.doors.door_tickets import TICKETS, DoorTickets
from appliance.features.doors.door_visits import VISITS, DoorVisits
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending


class Ticket(Ending):
    kind = TICKETS

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.tickets = DoorTickets(store, ends)

    async def begin(self, seconds: float) -> None:
        self.tickets.make("alice", seconds, "ann")

    def lasts(self) -> bool:
        return bool(self.tickets.valid("alice"))


class Visit(Ending):
    kind = VISITS
    text = ""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.visits = DoorVisits(ends, lambda: {"1": "ann"})

    async def begin(self, seconds: float) -> None:
        _row, self.text = self.visits.make("alice", "ann", seconds)

    def lasts(self) -> bool:
        return self.visits.find("alice", self.text) is not None
