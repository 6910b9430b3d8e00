"""Count connections by host, with the bytes they hold, and choose connections that make room.

Invariants:

1. Connections, the bytes they hold (requests without an answer, answers not read yet) and connections that wait for
   their refusal are pools of `appliance/quotas`: no number of addresses gets more than its class may have.
2. If a host is within its share but its class or the whole is full, it gets the place of another connection. Candidates
   have its own quota class or a lower one. The lowest class comes first, then idle, unfinished and served connections
   in this order, then the longest wait. `patience` is the minimum wait: at RVMaster an idle connection makes room at
   once (ROS clients reconnect), an unfinished one of the same quota class after a second, and a served one never.
3. If bytes are short, the largest connection of a host that holds more makes room.
"""

import asyncio
import math
import time
from collections.abc import Callable
from enum import StrEnum
from typing import Generic, Protocol

from appliance.quotas.pool import Bounds, Holder, Pool, QuotaClass
from appliance.quotas.queue import Queue
from appliance.quotas.table import RVMASTER_ARRIVALS, RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_FAREWELLS


class Stage(StrEnum):
    """The stage of a connection."""

    IDLE = "idle"
    """All requests are answered."""

    UNFINISHED = "unfinished"
    """It waits for the rest of a request, for its turn, or for the peer to read an answer."""

    SERVED = "served"
    """A handler works on its request."""


class TrackedConnection(Protocol):
    """A connection, as the table needs it; `deadline` is in monotonic seconds."""

    deadline: float

    @property
    def holding(self) -> int:
        """Return the bytes held for it, which its end releases."""

    def expire(self) -> None:
        """Handle a passed deadline."""

    def abort(self) -> None:
        """End now, and `leave`."""


Patience = Callable[[QuotaClass, Stage, bool], float]
"""Return the seconds that a connection keeps its place. True: against hosts of the same quota class."""


def _of_ros(_quota_class: QuotaClass, stage: Stage, own: bool) -> float:
    if stage is Stage.SERVED:
        return math.inf
    return 1.0 if own and stage is Stage.UNFINISHED else 0.0


class ConnectionTable(Generic[Holder]):
    """Count the connections of all listeners that share it. `quota_class` returns the present quota class of a host.

    `connection_class` does so for connections, open or not (None: `quota_class`).
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
        clock: Callable[[], float] = time.monotonic,
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
        """Return all connections, also those being turned away."""
        return frozenset(self._of)

    def enter(self, connection: TrackedConnection, host: Holder) -> str:
        """Add a connection; return why not, if there is no room and no connection makes room (else empty)."""
        why = self._take(self.connected, host, 1)
        if not why:
            self._of[connection] = host, self.connected
            self.file(connection, Stage.UNFINISHED)
        return why

    def turn_away(self, connection: TrackedConnection, host: Holder) -> bool:
        """Count a connection beyond the limit that stays for its refusal; return False if it may not."""
        if self.farewells.take(host):
            return False
        self._of[connection] = host, self.farewells
        return True

    def leave(self, connection: TrackedConnection) -> None:
        """Remove a connection; ignore an unknown one."""
        if connection in self._stages:
            self._queues[self._stages.pop(connection)].remove(connection)
        host, pool = self._of.pop(connection, (None, self.connected))
        if host is not None:
            pool.give_back(host)

    def file(self, connection: TrackedConnection, stage: Stage) -> None:
        """Set the stage of a connection."""
        host, pool = self._of.get(connection, (None, self.farewells))
        if host is None or pool is not self.connected:
            return
        before = self._stages.get(connection)
        if before is not None:
            self._queues[before].remove(connection)
        self._stages[connection] = stage
        self._queues[stage].put(connection, host, self._clock())

    def hold(self, host: Holder, size: int) -> str:
        """Count bytes held for a host. If they are too many, return the reason and count nothing."""
        return self._take(self.held, host, size)

    def release(self, host: Holder, size: int) -> None:
        """Release bytes."""
        self.held.give_back(host, size)

    async def sweep(self) -> None:
        """Expire connections past their deadline, once a second, until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            for connection in [connection for connection in self._of if connection.deadline < now]:
                connection.expire()

    def _take(self, pool: Pool[Holder], host: Holder, amount: int) -> str:
        why = pool.take(host, amount)
        while why and pool.held(host) + amount <= pool.bounds.host:
            victim = self._to_make_room(host) if pool is self.connected else self._to_free_bytes(host)
            if victim is None:
                break
            victim.abort()
            why = pool.take(host, amount)
        return why

    def _to_make_room(self, host: Holder) -> TrackedConnection | None:
        """Return the connection whose place this host may have."""
        mine = self._connection_class(host)
        for quota_class in QuotaClass:
            if quota_class > mine:
                return None
            for stage, queue in self._queues.items():
                found = queue.longest(quota_class)
                patience = self._patience(quota_class, stage, quota_class is mine)
                if found is not None and self._clock() - found[2] >= patience:
                    return found[0]
        return None

    def _to_free_bytes(self, host: Holder) -> TrackedConnection | None:
        """Return the connection with the most bytes among those that may be ended for this host."""
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
