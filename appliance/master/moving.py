"""What the specifications need of the relays: telling them, and having topics carried by another one.

A topic moves when a specification that was loaded connects it with what another relay carries. It is carried by
nobody for as long as its connections take to be made anew; subscribers are told to drop its publishers and to take
them again, since neither client library leaves a connection for a list it knows.
"""

from collections.abc import Sequence
from typing import Protocol

from appliance.channel.messages import Message
from appliance.master.allocation import TOPIC, Move, Resource
from appliance.master.graph import Graph
from appliance.master.relays import RelayControl
from appliance.master.reminders import Reminders


class Relays(Protocol):
    """The relays, as the specifications see them."""

    def send(self, message: Message, relay: int) -> bool:
        """Tell a relay; False when it is not there."""

    def carried_now(self) -> set[Resource]:
        """Topics and services of nodes that live."""

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Before the new allocation is adopted: these are carried by nobody."""

    def place(self, moves: Sequence[Move]) -> None:
        """After it was adopted: these are carried where they belong now."""


class NoRelays:
    """Before control is assembled: there is nobody to tell."""

    def send(self, message: Message, relay: int) -> bool:  # noqa: ARG002 - as `Relays`
        """Nobody is there."""
        return False

    def carried_now(self) -> set[Resource]:
        """Nothing is carried."""
        return set()

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Nothing is carried."""

    def place(self, moves: Sequence[Move]) -> None:
        """Nothing is carried."""


class Moving:
    """`Relays` over the real ones."""

    def __init__(self, relay: RelayControl, graph: Graph, reminders: Reminders) -> None:
        self._relay = relay
        self._graph = graph
        self._reminders = reminders

    def send(self, message: Message, relay: int) -> bool:
        """Tell a relay; False when it is not there."""
        return self._relay.send(message, relay)

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
                self._graph.renew_all(move.name)
        if moves:
            self._reminders.begin()
