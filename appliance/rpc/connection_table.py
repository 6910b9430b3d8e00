"""Count the connections of each host and the bytes that they hold; evict connections to make room.

1. A host within its own quota evicts another connection of the same or a lower quota class if the pool or its class
   is full. A host beyond its own quota evicts its own idle connection that was used longest ago: the nodes of a large
   robot keep more connections than the quota of one host.
2. The lowest class is evicted first. In a class, idle connections are evicted before unfinished connections, and
   these before served connections. In each stage, the longest wait is evicted first.
3. `patience` is the minimum wait before an eviction. At RVMaster, an idle connection is evicted at once, because ROS
   clients reconnect. A served connection is never evicted.
4. If bytes are short, the largest unfinished connection of a host with more bytes or a lower class is evicted.
"""

import asyncio
import math
from collections.abc import Callable
from enum import StrEnum
from typing import Generic, Protocol

from appliance.base import clock
from appliance.quotas.pool import Bounds, Holder, Pool, Queue, QuotaClass
from appliance.quotas.table import RVMASTER_ARRIVALS, RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_FAREWELLS

_MAX_MOVED = 64  # the most idle connections that one search moves


class Stage(StrEnum):
    IDLE = "idle"

    UNFINISHED = "unfinished"
    """The connection waits for the rest of a request, for its turn, or for the peer to read an answer."""

    SERVED = "served"
    """A handler works on a request."""


class TrackedConnection(Protocol):
    """A connection in the table; `deadline` and the time of the last progress are in monotonic seconds."""

    deadline: float
    progress: float

    @property
    def holding(self) -> int:
        """Return the bytes that are released when the connection ends."""

    def expire(self) -> None:
        """End the connection after its deadline."""

    def abort(self) -> None:
        """End now, and `leave` the table."""


Patience = Callable[[QuotaClass, Stage, bool], float]
"""Returns the seconds before a connection may be evicted. True: a host of the same quota class needs the room."""


def _of_ros(_quota_class: QuotaClass, stage: Stage, own: bool) -> float:
    if stage is Stage.SERVED:
        return math.inf
    return 1.0 if own and stage is Stage.UNFINISHED else 0.0


class ConnectionTable(Generic[Holder]):
    """The connections of listeners, which may share the table.

    `connection_class` returns the class that counts for connections (None: `quota_class`).
    """

    def __init__(
        self,
        quota_class: Callable[[Holder], QuotaClass],
        *,
        connections: Bounds = RVMASTER_CONNECTIONS.bounds,
        held: Bounds = RVMASTER_BYTES.bounds,
        farewells: Bounds = RVMASTER_FAREWELLS.bounds,
        arriving: Bounds = RVMASTER_ARRIVALS.bounds,
        connection_class: Callable[[Holder], QuotaClass] | None = None,
        patience: Patience = _of_ros,
        clock: Callable[[], float] = clock.now,
    ) -> None:
        self._quota_class = quota_class
        self._connection_class = of_connections = connection_class or quota_class
        self._patience = patience
        self._clock = clock
        unknown = "hosts that no rule or only * names, without a registration,"
        self.connected: Pool[Holder] = Pool("connections open", connections, of_connections, unknown)
        self.held: Pool[Holder] = Pool("bytes in requests and answers under way", held, quota_class)
        self.farewells: Pool[Holder] = Pool(
            "connections that are turned away", farewells, of_connections, unknown
        )
        self.arriving: Pool[Holder] = Pool(
            "connections that wait to be opened", arriving, of_connections, unknown
        )
        self._of: dict[TrackedConnection, tuple[Holder, Pool[Holder]]] = {}
        self._queues: dict[Stage, Queue[Holder, TrackedConnection]] = {
            stage: Queue(of_connections) for stage in Stage
        }
        self._stages: dict[TrackedConnection, Stage] = {}

    @property
    def connections(self) -> frozenset[TrackedConnection]:
        return frozenset(self._of)

    def enter(self, connection: TrackedConnection, host: Holder) -> str:
        why = self._take(self.connected, host, 1)
        if not why:
            self._of[connection] = host, self.connected
            self.file(connection, Stage.UNFINISHED)
        return why

    def turn_away(self, connection: TrackedConnection, host: Holder) -> bool:
        if self.farewells.take(host):
            return False
        self._of[connection] = host, self.farewells
        return True

    def leave(self, connection: TrackedConnection) -> None:
        if connection in self._stages:
            self._queues[self._stages.pop(connection)].remove(connection)
        host, pool = self._of.pop(connection, (None, self.connected))
        if host is not None:
            pool.give_back(host)

    def file(self, connection: TrackedConnection, stage: Stage) -> None:
        before = self._stages.get(connection)
        if before is stage is Stage.IDLE:  # `_longest` finds out that it was used
            return
        host, pool = self._of.get(connection, (None, self.farewells))
        if host is None or pool is not self.connected:
            return
        if before is not None:
            self._queues[before].remove(connection)
        self._stages[connection] = stage
        self._queues[stage].put(connection, host, self._clock())

    def hold(self, host: Holder, size: int) -> str:
        """Count bytes. If there are too many, count none and return the reason."""
        return self._take(self.held, host, size)

    def release(self, host: Holder, size: int) -> None:
        self.held.give_back(host, size)

    async def sweep(self) -> None:
        while True:
            await asyncio.sleep(1.0)
            now = clock.now()
            for connection in [connection for connection in self._of if connection.deadline < now]:
                connection.expire()

    def _take(self, pool: Pool[Holder], host: Holder, amount: int) -> str:
        why = pool.take(host, amount)
        while why and (victim := self._victim(pool, host, amount)) is not None:
            victim.abort()
            why = pool.take(host, amount)
        return why

    def _victim(self, pool: Pool[Holder], host: Holder, amount: int) -> TrackedConnection | None:
        beyond = pool.held(host) + amount > pool.bounds.host
        if pool is self.connected:
            return self._own_idle(host) if beyond else self._to_make_room(host)
        return None if beyond else self._to_free_bytes(host)

    def _own_idle(self, host: Holder) -> TrackedConnection | None:
        """Return the host's idle connection that was used longest ago."""
        idle = self._queues[Stage.IDLE].of_host(host)
        found = min(idle, key=lambda connection: connection.progress, default=None)
        patience = self._patience(self._connection_class(host), Stage.IDLE, True)
        waited = found is not None and self._clock() - found.progress >= patience
        return found if waited else None

    def _to_make_room(self, host: Holder) -> TrackedConnection | None:
        mine = self._connection_class(host)
        for quota_class in QuotaClass:
            if quota_class > mine:
                return None
            for stage, queue in self._queues.items():
                found = self._longest(stage, queue, quota_class)
                patience = self._patience(quota_class, stage, quota_class is mine)
                if found is not None and self._clock() - found[2] >= patience:
                    return found[0]
        return None

    def _longest(
        self, stage: Stage, queue: Queue[Holder, TrackedConnection], quota_class: QuotaClass
    ) -> tuple[TrackedConnection, Holder, float] | None:
        """Return the connection that waits longest; idle ones that were used again are moved back first."""
        for _ in range(_MAX_MOVED):
            found = queue.longest(quota_class)
            if found is None or stage is not Stage.IDLE or found[0].progress <= found[2]:
                return found
            queue.put(found[0], found[1], found[0].progress)
        return None

    def _to_free_bytes(self, host: Holder) -> TrackedConnection | None:
        mine, most = self._quota_class(host), self.held.held(host)
        able = [
            connection
            for connection in self._queues[Stage.UNFINISHED]
            if connection.holding
            and (
                self._quota_class(self._of[connection][0]) < mine
                or self.held.held(self._of[connection][0]) > most
            )
            and self._quota_class(self._of[connection][0]) <= mine
        ]
        return max(able, key=lambda visitor: visitor.holding, default=None)
