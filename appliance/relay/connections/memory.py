"""How much of the relay's memory each host may have waiting, and how much of it latched.

Four pools: what is not whole yet (frames, requests, replies), what waits for slow subscribers and clients, what is
latched, and connection headers. Each is counted by host: what comes by its publisher's or service's (a request: its
client's), what waits by that of the peer it waits for. A queue cannot take the memory that frames need.

Invariants, besides those of `Pool`:

1. A host gets no more while it holds as much as is free. So one that is alone has half, *n* that take all they can
   have a part of *n* + 1 each, and as much is free for the next: no number of hosts takes everything.
2. What is beyond a host's share is given up when something of that host moves, or at the next look (once a second);
   latched messages, when a host that has less wants one kept. Nothing stays refused when what it was refused for is
   gone.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

from appliance.quotas.pool import Pool, Standing
from appliance.quotas.table import RELAY_FRAMES, RELAY_HEADERS, RELAY_LATCHED, RELAY_QUEUES, Share
from appliance.relay.bounds import Limits


class HostShare:
    """The part of one host in a pool of bytes."""

    __slots__ = ("_host", "_pool")

    def __init__(self, pool: Pool[str], host: str) -> None:
        self._pool = pool
        self._host = host

    @property
    def used(self) -> int:
        """The bytes of this host."""
        return self._pool.held(self._host)

    def add(self, size: int) -> None:
        """Count so many bytes more of this host; fewer, where `size` is below 0."""
        if size > 0:
            self._pool.charge(self._host, size)
        elif size:
            self._pool.give_back(self._host, -size)

    def refusal(self, size: int = 1) -> str:
        """Why so many bytes more of this host should not be kept; empty when they may be."""
        pool = self._pool
        held, left = pool.held(self._host) + size, pool.bounds.whole - pool.total - size
        if held > left:
            return (
                f"{self._host} would have {held} {pool.what}, and {max(left, 0)} would be left for all others;"
                " a host may have as many as are left"
            )
        return pool.refusal(self._host, size)

    @property
    def exhausted(self) -> bool:
        """Whether nothing more of this host should be kept."""
        return bool(self.refusal())

    @property
    def plenty(self) -> bool:
        """Whether less than half of the pool is in use."""
        return self._pool.total * 2 < self._pool.bounds.whole


class HostShares(Pool[str]):
    """A pool of bytes, and the share of each host in it."""

    def of(self, host: str) -> HostShare:
        """The share of the host with this address."""
        return HostShare(self, host)


@dataclass(frozen=True, slots=True)
class Memory:
    """The shares of all hosts in the four pools."""

    frames: HostShares
    queues: HostShares
    latched: HostShares
    headers: HostShares

    @classmethod
    def of(cls, limits: Limits, standing: Callable[[str], Standing]) -> "Memory":
        """The pools of one relay: `memory_bytes` is parted as the defaults of the table are."""
        rows = (RELAY_FRAMES, RELAY_QUEUES, RELAY_LATCHED)
        together = sum(row.bounds.whole for row in rows)

        def shares(row: Share, whole: int) -> HostShares:
            return HostShares(row.thing.partition(" in ")[0], row.bounds.sized(whole), standing)

        frames, queues, latched = (
            shares(row, row.bounds.whole * limits.memory_bytes // together) for row in rows
        )
        return cls(frames, queues, latched, shares(RELAY_HEADERS, limits.header_memory_bytes))

    def held(self) -> dict[str, int]:
        """The bytes in each pool."""
        return {pool.name: getattr(self, pool.name).total for pool in fields(self)}


class Weight:
    """What one connection holds of a share."""

    def __init__(self, share: HostShare) -> None:
        self.share = share
        self._size = 0

    def set(self, size: int) -> None:
        """Say how many bytes there are now."""
        self.share.add(size - self._size)
        self._size = size


class Stall:
    """Notices that what is held of something unfinished has not changed for so many seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._held = 0
        self._since = 0.0

    def seen(self, held: int, now: float) -> bool:
        """Say how much is held now (0: nothing is unfinished); whether it has been too long."""
        if not held or held != self._held:
            self._held, self._since = held, now
            return False
        return now - self._since > self._seconds
