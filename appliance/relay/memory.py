"""How much of the relay's memory each host may have waiting.

Invariant: a host that has a quarter of it gets no more while half of it is in use; so no host alone can take what the
others need, and one that is alone has half.
"""

from weakref import WeakValueDictionary

from appliance.relay.frames import MemoryBudget


class HostShare:
    """The bytes of one host that wait, counted in the budget of all."""

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._own = 0

    @property
    def used(self) -> int:
        """The bytes of this host."""
        return self._own

    @used.setter
    def used(self, size: int) -> None:
        self._budget.used += size - self._own
        self._own = size

    @property
    def exhausted(self) -> bool:
        """Whether nothing more of this host should be kept."""
        budget = self._budget
        return budget.exhausted or (self._own * 4 >= budget.limit and budget.used * 2 >= budget.limit)


class HostShares:
    """The share of each host that has connections."""

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._shares: WeakValueDictionary[str, HostShare] = WeakValueDictionary()

    def of(self, host: str) -> HostShare:
        """The share of the host with this address; kept by whoever counts in it."""
        share = self._shares.get(host)
        if share is None:
            share = self._shares[host] = HostShare(self._budget)
        return share


class Stall:
    """Notices that what is held of something unfinished has not changed for so many seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._held = 0
        self._since = 0.0

    def seen(self, held: int, now: float) -> bool:
        """So much is held now (0: nothing is unfinished); whether it has been too long."""
        if not held or held != self._held:
            self._held, self._since = held, now
            return False
        return now - self._since > self._seconds
