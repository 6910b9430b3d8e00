"""The processor time that the next message of a publication, or of a service's client, may take.

After a message is cut off, others get a tenth of the budget for some seconds, because more may follow: those of at
least half its size, since shorter ones cost less. Hosts that the policy does not name share one budget, because each of
many addresses could send such a message.
"""

from collections.abc import Callable

from appliance.relay.monitors.observation_points import ObservationPoint
from rosmop.run.outcomes import FUEL_PER_SECOND

_SHORTEST = 4_000_000_000
_LONGEST = 16_000_000_000
_REDUCED = 0.1


class TimeBudget:
    """The fraction of the time budget for messages of one point; times are nanoseconds of the monitors' clock."""

    __slots__ = ("_length", "_size", "_until")

    def __init__(self) -> None:
        self._length = 0
        self._until = 0
        self._size = 0

    def part(self, now: int, size: int) -> float:
        return _REDUCED if now < self._until and 2 * size >= self._size else 1.0

    def fuel(self, now: int, budget: float, size: int) -> int:
        """Return the most instructions for one message of `size` bytes; `budget` is in seconds."""
        return int(FUEL_PER_SECOND * budget * self.part(now, size))

    def cut(self, now: int, size: int) -> None:
        if now < self._until:
            self._size = min(self._size, size)
            return
        self._length = _SHORTEST if self.has_recovered(now) else min(2 * self._length, _LONGEST)
        self._until, self._size = now + self._length, size

    def has_recovered(self, now: int) -> bool:
        return now >= self._until + self._length


class TimeBudgets:
    """The budgets of all publications and clients; `payer(host)` is another text for a host that shares a budget."""

    def __init__(self, payer: Callable[[str], str]) -> None:
        self._payer = payer
        self._shared = TimeBudget()
        self._own: dict[ObservationPoint, TimeBudget] = {}

    def of(self, point: ObservationPoint) -> TimeBudget:
        if self._payer(point.host) != point.host:
            return self._shared
        if point not in self._own:
            self._own[point] = TimeBudget()
        return self._own[point]

    def forget_recovered(self, now: int) -> None:
        self._own = {point: budget for point, budget in self._own.items() if not budget.has_recovered(now)}
