"""Who is connected to listeners, what the connections hold, and who makes room when there is none.

Invariants:

1. Connections, the bytes they hold (bodies that are not answered, answers that are not taken) and those that are being
   told that they are too many are pools of `appliance/quotas`: no number of addresses has more than its class may.
2. A host that is within its own share and finds its class or the whole full gets the place of another connection, if
   there is one: of the lowest standing that is not above its own, an idle one before one whose request is not whole and
   that before one that is served, and the one that is so for the longest. `patience` says for how long it is so at
   least: at RVMaster an idle one costs its client nothing (ROS clients connect again), of its own standing what is
   unfinished makes room after a second, and what is served never does.
3. Where bytes are short, the connection that holds most of a host that holds more makes room.
"""

import asyncio
import math
import time
from collections.abc import Callable
from enum import StrEnum
from typing import Generic, Protocol

from appliance.quotas.pool import Bounds, Holder, Pool, Standing
from appliance.quotas.queue import Queue
from appliance.quotas.table import RVMASTER_ARRIVALS, RVMASTER_BYTES, RVMASTER_CONNECTIONS, RVMASTER_FAREWELLS


class Stage(StrEnum):
    """Where a connection is in its requests."""

    IDLE = "idle"
    """Everything it asked is answered."""

    UNFINISHED = "unfinished"
    """Its next request, or its turn, is awaited, or that it takes its answer."""

    SERVED = "served"
    """It is being served."""


class Connection(Protocol):
    """What is asked of a connection here; `deadline` is in monotonic seconds."""

    deadline: float

    @property
    def holding(self) -> int:
        """The bytes that are held for it and that its end sets free."""

    def expire(self) -> None:
        """The deadline has passed."""

    def abort(self) -> None:
        """End now, and `leave`."""


Patience = Callable[[Standing, Stage, bool], float]
"""Seconds that a connection of this standing keeps its place at this stage (True: from hosts of its own standing)."""


def _of_ros(_standing: Standing, stage: Stage, own: bool) -> float:
    if stage is Stage.SERVED:
        return math.inf
    return 1.0 if own and stage is Stage.UNFINISHED else 0.0


class Visitors(Generic[Holder]):
    """All connections of every listener that shares it, by host. `standing` says what is known of a host now.

    `standing_of_arrivals` counts connections that wait to be opened (None: the same).
    """

    def __init__(
        self,
        standing: Callable[[Holder], Standing],
        *,
        connections: Bounds = RVMASTER_CONNECTIONS.bounds,
        held: Bounds = RVMASTER_BYTES.bounds,
        farewells: Bounds = RVMASTER_FAREWELLS.bounds,
        arriving: Bounds = RVMASTER_ARRIVALS.bounds,
        standing_of_arrivals: Callable[[Holder], Standing] | None = None,
        patience: Patience = _of_ros,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._standing = standing
        self._patience = patience
        self._clock = clock
        self.connected: Pool[Holder] = Pool("connections open", connections, standing)
        self.held: Pool[Holder] = Pool("bytes in requests and answers under way", held, standing)
        self.farewells: Pool[Holder] = Pool("connections that are turned away", farewells, standing)
        self.arriving: Pool[Holder] = Pool(
            "connections that wait to be opened",
            arriving,
            standing_of_arrivals or standing,
            "hosts that no rule or only * names, without a registration,",
        )
        self._of: dict[Connection, tuple[Holder, Pool[Holder]]] = {}
        self._queues: dict[Stage, Queue[Holder, Connection]] = {stage: Queue(standing) for stage in Stage}
        self._stages: dict[Connection, Stage] = {}

    @property
    def connections(self) -> frozenset[Connection]:
        """All that are here, those that are being turned away included."""
        return frozenset(self._of)

    def enter(self, connection: Connection, host: Holder) -> str:
        """Count a connection in; why not, when there is no room and nobody makes it."""
        why = self._take(self.connected, host, 1)
        if not why:
            self._of[connection] = host, self.connected
            self.file(connection, Stage.UNFINISHED)
        return why

    def turn_away(self, connection: Connection, host: Holder) -> bool:
        """Whether a connection that is too many may stay until it was told so; it is counted then."""
        if self.farewells.take(host):
            return False
        self._of[connection] = host, self.farewells
        return True

    def leave(self, connection: Connection) -> None:
        """Count a connection out, if it is in."""
        if connection in self._stages:
            self._queues[self._stages.pop(connection)].remove(connection)
        host, pool = self._of.pop(connection, (None, self.connected))
        if host is not None:
            pool.give_back(host)

    def file(self, connection: Connection, stage: Stage) -> None:
        """The connection is at this stage from now on."""
        host, pool = self._of.get(connection, (None, self.farewells))
        if host is None or pool is not self.connected:
            return
        before = self._stages.get(connection)
        if before is not None:
            self._queues[before].remove(connection)
        self._stages[connection] = stage
        self._queues[stage].put(connection, host, self._clock())

    def hold(self, host: Holder, size: int) -> str:
        """Count bytes in that are kept for a host; why not (nothing is counted) when it is too much."""
        return self._take(self.held, host, size)

    def release(self, host: Holder, size: int) -> None:
        """Count bytes out."""
        self.held.give_back(host, size)

    async def sweep(self) -> None:
        """Every second, close the connections whose deadline has passed; runs until cancelled."""
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

    def _to_make_room(self, host: Holder) -> Connection | None:
        """The connection whose place this host may have."""
        mine = self._standing(host)
        for standing in Standing:
            if standing > mine:
                return None
            for stage, queue in self._queues.items():
                found = queue.longest(standing)
                patience = self._patience(standing, stage, standing is mine)
                if found is not None and self._clock() - found[2] >= patience:
                    return found[0]
        return None

    def _to_free_bytes(self, host: Holder) -> Connection | None:
        """The connection that holds most of all that may be ended for this host."""
        mine, most = self._standing(host), self.held.held(host)
        able = [
            connection
            for connection in self._queues[Stage.UNFINISHED]
            if connection.holding
            and (
                self._standing(self._of[connection][0]) < mine
                or self.held.held(self._of[connection][0]) > most
            )
            and self._standing(self._of[connection][0]) <= mine
        ]
        return max(able, key=lambda visitor: visitor.holding, default=None)
