"""What the specifications need of the relays (`specifications.relays`), of the real ones.

A topic moves when a specification that was loaded connects it with what another relay carries. It is carried by
nobody for as long as its connections take to be made anew; subscribers are told to drop its publishers and to take
them again, since neither client library leaves a connection for a list it knows.
"""

from collections.abc import Sequence

from appliance.channel.messages import Message
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import Graph
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.reminders import Reminders
from appliance.specifications.allocation import TOPIC, Move, Resource


class Moving:
    """The relays that there are, with the graph whose topics they carry."""

    def __init__(self, relay: RelayControl, graph: Graph, enactor: Enactor, reminders: Reminders) -> None:
        self._relay = relay
        self._graph = graph
        self._enactor = enactor
        self._reminders = reminders

    def send(self, message: Message, relay: int) -> bool:
        """Tell a relay; False when it is not there."""
        return self._relay.send(message, relay)

    async def carried_out(self) -> None:
        """Wait until every relay has carried out what it was told."""
        await self._relay.carried_out()

    def carried_now(self) -> set[Resource]:
        """Topics and services of nodes that live."""
        return self._relay.carried_now()

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Before the new allocation is adopted: these are carried by nobody."""
        self._relay.withdraw_moving(moves)

    def place(self, moves: Sequence[Move]) -> None:
        """After it was adopted: these are carried where they belong now."""
        self._relay.place_moved(moves)
        for move in moves:
            if move.kind == TOPIC:
                self._enactor.carry_out(self._graph.renew_all(move.name))
        if moves:
            self._reminders.begin()
