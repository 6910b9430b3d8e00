"""Keep the ends of tokens and sessions by the system time, although its clock may step back."""

import math
from collections.abc import Collection, Mapping

from appliance.base import clock


class Deadlines:
    """Ends in seconds since the epoch. An end has passed once the system time *or* the time since boot shows it.

    An end is compared with the system time when it is first seen. From then on, a step back of the clock, such as by
    a false time service, postpones nothing.
    """

    def __init__(self) -> None:
        self._deadlines: dict[str, tuple[float, float]] = {}
        self._limits: dict[str, float] = {}  # by name: the latest end, in seconds since the boot

    def passed(self, name: str, end: float) -> bool:
        known = self._deadlines.get(name)
        if known is None or known[0] != end:
            known = self._deadlines[name] = end, clock.since_boot() + end - clock.wall()
        return clock.wall() >= end or clock.since_boot() >= min(known[1], self._limits.get(name, math.inf))

    def limit(self, left: Mapping[str, float]) -> None:
        """After a restart, limit the ends to the seconds that were left, whatever the system time is."""
        now = clock.since_boot()
        for name, seconds in left.items():
            self._limits[name] = min(now + seconds, self._limits.get(name, math.inf))

    def retain(self, names: Collection[str]) -> None:
        self._deadlines = {name: known for name, known in self._deadlines.items() if name in names}

    def forget(self, name: str) -> None:
        """Forget a name, which must never be used again."""
        self._deadlines.pop(name, None)
        self._limits.pop(name, None)

    def left(self) -> dict[str, float]:
        now = clock.since_boot()
        return {
            name: max(0.0, min(end, self._limits.get(name, math.inf)) - now)
            for name, (_wall, end) in self._deadlines.items()
        }
