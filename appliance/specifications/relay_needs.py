"""What the specifications need of the relays: telling them, and having topics carried by another one."""

from collections.abc import Sequence
from typing import Protocol

from appliance.channel.messages import Message
from appliance.specifications.allocation import Move, Resource


class Relays(Protocol):
    """The relays, as the specifications see them."""

    def send(self, message: Message, relay: int) -> bool:
        """Tell a relay; False when it is not there."""

    async def carried_out(self) -> None:
        """Wait until every relay has carried out what it was told."""

    def carried_now(self) -> set[Resource]:
        """Topics and services of nodes that live."""

    def withdraw(self, moves: Sequence[Move]) -> None:
        """Before the new allocation is adopted: these are carried by nobody."""

    def place(self, moves: Sequence[Move]) -> None:
        """After it was adopted: these are carried where they belong now."""
