"""How much processor time the next message of a publication, or of a service's client, may take.

A message that takes all of the budget is cut off, and whoever sends one may send more. So for a second after it the
next ones have a tenth. Messages that are cut off within that second do not prolong it. Hosts that the policy does not
name have one pace together, as many addresses could each send such a message.
"""

from rosmop.runtime.action_context import FUEL_PER_SECOND

_SECOND = 1_000_000_000
_AGAIN = 0.1


class Pace:
    """The part of the budget that messages from one place have; times are nanoseconds of the monitors' clock."""

    __slots__ = ("_until",)

    def __init__(self) -> None:
        self._until = 0

    def part(self, now: int) -> float:
        """Return the part of the budget that a message has now."""
        return _AGAIN if now < self._until else 1.0

    def fuel(self, now: int, budget: float) -> int:
        """Return the instructions of a module that a message has now, of a budget in seconds."""
        return int(FUEL_PER_SECOND * budget * self.part(now))

    def cut(self, now: int) -> None:
        """Note that a message took all of its time."""
        if now >= self._until:
            self._until = now + _SECOND
