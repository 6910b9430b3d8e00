"""Serve requests of hosts in turn, so that one host's flood costs the others little.

Slots are a pool of `appliance/quotas`. A host without a free slot waits. The next slot goes to the host with the
longest wait since its last turn, whatever the number and duration of other hosts' requests. Hosts that are alike (the
policy names them as one network) share one turn and half of the slots, so additional addresses are useless.
"""

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, QuotaClass

Queue = deque[asyncio.Future[None]]


def itself(host: Address) -> Hashable:
    """Return the host itself, for hosts without others alike."""
    return host


class Turns:
    """The slots of requests within the shares of `bounds`; other requests wait in turn.

    While a slot is free, requests wait only because of their host's share, or that of hosts alike. `alike(host)` is
    equal for hosts that share turns. `pause(host)` returns the seconds until the next check of a host that owes for its
    audit records; it waits without a slot.
    """

    def __init__(
        self,
        bounds: Bounds,
        quota_class: Callable[[Address], QuotaClass],
        alike: Callable[[Address], Hashable] = itself,
        pause: Callable[[str], float] = lambda _host: 0.0,
    ) -> None:
        self.slots: Pool[Address] = Pool("requests being served", bounds, quota_class)
        self._alike = alike
        self.pause = pause
        self._together = max(bounds.host, bounds.whole // 2)
        self._taken: Counter[Hashable] = Counter()  # by group of hosts alike
        self._taken_as: dict[Address, Hashable] = {}
        self.waiting: OrderedDict[Hashable, OrderedDict[Address, Queue]] = OrderedDict()

    async def enter(self, host: Address) -> None:
        """Wait until this host's records are paid, then take a slot or wait for a turn."""
        while seconds := self.pause(str(host)):
            await asyncio.sleep(seconds)
        kind = self._alike(host)
        if self._take(host, kind):
            return
        turn = asyncio.get_running_loop().create_future()
        self.waiting.setdefault(kind, OrderedDict()).setdefault(host, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.leave(host)
            else:
                self._give_up(kind, host, turn)
            raise

    def leave(self, host: Address) -> None:
        """Release the slot to the longest waiting host that may have it."""
        self._give_back(host)
        while (following := self._next()) is not None:
            kind, host = following
            hosts = self.waiting.pop(kind)
            queue = hosts.pop(host)
            turn = queue.popleft()
            if queue:
                hosts[host] = queue  # at the end of the line: the next request waits a round
            if hosts:
                self.waiting[kind] = hosts
            if turn.done():  # its task was cancelled, and has not yet run to give up its place
                self._give_back(host)
            else:
                turn.set_result(None)

    def _next(self) -> tuple[Hashable, Address] | None:
        """Take a slot for the next host, and return its group and the host."""
        for kind, hosts in self.waiting.items():
            if self._taken[kind] < self._together:
                for host in hosts:
                    if self._take(host, kind):
                        return kind, host
        return None

    def _take(self, host: Address, kind: Hashable) -> bool:
        kind = self._taken_as.get(host, kind)  # the group of its other slots
        if self._taken[kind] >= self._together or self.slots.take(host):
            return False
        self._taken[kind] += 1
        self._taken_as[host] = kind
        return True

    def _give_back(self, host: Address) -> None:
        self.slots.give_back(host)
        kind = self._taken_as[host]
        self._taken[kind] -= 1
        if not self._taken[kind]:
            del self._taken[kind]
        if not self.slots.held(host):
            del self._taken_as[host]

    def _give_up(self, kind: Hashable, host: Address, turn: asyncio.Future[None]) -> None:
        hosts = self.waiting.get(kind, OrderedDict())
        queue = hosts.get(host)
        if queue is None or turn not in queue:
            return
        queue.remove(turn)
        if not queue:
            del hosts[host]
        if not hosts:
            self.waiting.pop(kind, None)
