"""Keep the ends of things by the system time, although its clock may step back."""

from appliance.base import clock


class Deadlines:
    """Ends in seconds since the epoch. One has passed as soon as the system time *or* the time since the boot says so.

    An end is compared with the system time when it is first seen. From then on, a step back of the clock, such as by a
    false time service, postpones nothing.
    """

    def __init__(self) -> None:
        self._deadlines: dict[str, tuple[float, float]] = {}

    def passed(self, name: str, end: float) -> bool:
        """Whether the end of `name` has passed."""
        known = self._deadlines.get(name)
        if known is None or known[0] != end:
            known = self._deadlines[name] = end, clock.since_boot() + end - clock.wall()
        return clock.wall() >= end or clock.since_boot() >= known[1]
