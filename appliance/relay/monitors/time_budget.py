"""The processor time of the next message of a publication, or of a service's client.

After a message that used up its budget and was cut off, the next ones have a tenth of it for four seconds, as their
sender may send more like it. If another one is cut off soon after that, the time doubles, up to 16 seconds. Messages
that are cut off within that time do not prolong it. Hosts that the policy does not name share one budget, because each
of many addresses could send such a message.
"""

from rosmop.runtime.action_context import FUEL_PER_SECOND

_SHORTEST = 4_000_000_000
_LONGEST = 16_000_000_000
_REDUCED = 0.1


class TimeBudget:
    """The part of the time budget for messages of one point; times are nanoseconds of the monitors' clock."""

    __slots__ = ("_length", "_until")

    def __init__(self) -> None:
        self._length = 0
        self._until = 0

    def part(self, now: int) -> float:
        """Return the part of the budget that a message has now."""
        return _REDUCED if now < self._until else 1.0

    def fuel(self, now: int, budget: float) -> int:
        """Return the instructions that a module may use for a message now, for a budget in seconds."""
        return int(FUEL_PER_SECOND * budget * self.part(now))

    def cut(self, now: int) -> None:
        """Reduce the budget, because a message used it up."""
        if now >= self._until:
            self._length = _SHORTEST if self.recovered(now) else min(2 * self._length, _LONGEST)
            self._until = now + self._length

    def recovered(self, now: int) -> bool:
        """Whether as much time has passed since the last reduction as it lasted."""
        return now >= self._until + self._length
