"""Divide the relay's memory among hosts.

A frame is charged to the host that sends it, a queue to the slow host. Invariants, besides those of `Pool`:

1. A host gets no more memory once it holds as much as is free, so each of *n* greedy hosts gets 1/(*n* + 1) of the
   pool, and the same amount stays free for the next host.
2. Memory beyond a host's quota is freed when the relay next handles its data, or within a second. A latched message
   is dropped when a host that holds less memory needs to latch one.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import RELAY_FRAMES, RELAY_HEADERS, RELAY_LATCHED, RELAY_QUEUES, QuotaRow
from appliance.relay.relay_limits import RelayLimits


class HostMemory:
    __slots__ = ("_pool", "host")

    def __init__(self, pool: Pool[str], host: str) -> None:
        self._pool = pool
        self.host = host

    @property
    def used(self) -> int:
        return self._pool.held(self.host)

    def add(self, size: int) -> None:
        if size > 0:
            self._pool.charge(self.host, size)
        elif size:
            self._pool.give_back(self.host, -size)

    def refusal(self, size: int = 1) -> str:
        return self._pool.refusal(self.host, size)

    @property
    def exhausted(self) -> bool:
        return bool(self.refusal())

    @property
    def plenty(self) -> bool:
        return self._pool.total * 2 < self._pool.bounds.whole


class KeptData(Protocol):
    """Data in a pool that can be given up, such as a latched message."""

    @property
    def size(self) -> int: ...

    def give_up(self) -> None: ...


class MemoryPool(Pool[str]):
    """A pool of bytes, divided among hosts."""

    def of(self, host: str) -> HostMemory:
        return HostMemory(self, host)

    def make_room(self, host: str, size: int, kept: Iterable[tuple[str, KeptData]]) -> None:
        """Give up data of hosts that hold more than `host` would with `size` more; `kept` has all data by host."""
        share, held_by = self.of(host), list(kept)
        while share.refusal(size):
            greatest, held = max(self.holders(), key=lambda holder: holder[1], default=("", 0))
            of_greatest = (data for owner, data in held_by if owner == greatest)
            largest = max(of_greatest, key=lambda data: data.size, default=None)
            if held <= share.used + size or largest is None or not largest.size:
                return
            largest.give_up()


@dataclass(frozen=True, slots=True)
class RelayMemory:
    """The pools of incomplete frames and requests, of queues, of latched messages, and of connection headers."""

    frames: MemoryPool
    queues: MemoryPool
    latched: MemoryPool
    headers: MemoryPool

    @classmethod
    def of(cls, limits: RelayLimits, quota_class: Callable[[str], QuotaClass]) -> "RelayMemory":
        rows = (RELAY_FRAMES, RELAY_QUEUES, RELAY_LATCHED)
        together = sum(row.bounds.whole for row in rows)

        def pool_of(row: QuotaRow, whole: int) -> MemoryPool:
            return MemoryPool(row.thing.partition(" in ")[0], row.bounds.resize(whole), quota_class)

        frames, queues, latched = (
            pool_of(row, row.bounds.whole * limits.memory_bytes // together) for row in rows
        )
        return cls(frames, queues, latched, pool_of(RELAY_HEADERS, limits.header_memory_bytes))

    def bytes_held(self) -> dict[str, int]:
        return {
            "frames": self.frames.total,
            "queues": self.queues.total,
            "latched": self.latched.total,
            "headers": self.headers.total,
        }


class HeldBytes:
    """The bytes that one connection holds in a pool."""

    def __init__(self, share: HostMemory) -> None:
        self.share = share
        self.size = 0

    def set(self, size: int) -> None:
        if size != self.size:
            self.share.add(size - self.size)
            self.size = size


class StallDetector:
    """Detects unfinished transfers that make no progress for some seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._held = 0
        self._since = 0.0

    def has_stalled(self, held: int, now: float) -> bool:
        """Return whether the bytes held (0: nothing is unfinished) have not changed for too long."""
        if not held or held != self._held:
            self._held, self._since = held, now
            return False
        return now - self._since > self._seconds
