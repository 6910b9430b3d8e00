"""Whose request is served next: hosts take turns, so that one host's flood costs the others little.

Slots are a pool of `appliance/quotas`; when none is left for a host, it waits, and the next goes to the host that
waited longest since its last turn, however many requests another has waiting and however long each of them takes.
Hosts that are alike (that the policy names as one network) take their turns as one and have half of the slots together:
nobody comes first more often by having many addresses.
"""

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable

from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, Standing

Queue = deque[asyncio.Future[None]]


def itself(host: Address) -> Hashable:
    """Of hosts that are like no other."""
    return host


class Turns:
    """Slots for requests being served, within the shares of `bounds`; who gets none waits in turn.

    Whenever a slot is free, everybody who waits does so because of his host's share, or that of hosts like it.
    `alike(host)` is the same for hosts that take their turns as one. `pause(host)` is for how many seconds a host that
    owes for its audit records waits before it is asked again, without a slot: who waits for its own debt keeps nothing
    that others need.
    """

    def __init__(
        self,
        bounds: Bounds,
        standing: Callable[[Address], Standing],
        alike: Callable[[Address], Hashable] = itself,
        pause: Callable[[str], float] = lambda _host: 0.0,
    ) -> None:
        self.slots: Pool[Address] = Pool("requests being served", bounds, standing)
        self._alike = alike
        self.pause = pause
        self._together = max(bounds.host, bounds.whole // 2)
        self._taken: Counter[Hashable] = Counter()  # by hosts that are alike
        self._taken_as: dict[Address, Hashable] = {}
        self.waiting: OrderedDict[Hashable, OrderedDict[Address, Queue]] = OrderedDict()

    async def enter(self, host: Address) -> None:
        """Take a slot, once this host's records are paid, waiting for its turn when there is none."""
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
        """Give the slot back: of the hosts that may have one, that which waited longest gets it."""
        self._give_back(host)
        while (following := self._next()) is not None:
            kind, host = following
            hosts = self.waiting.pop(kind)
            queue = hosts.pop(host)
            turn = queue.popleft()
            if queue:
                hosts[host] = queue  # to the end of the line: its next request waits a round
            if hosts:
                self.waiting[kind] = hosts
            if turn.done():  # its task was cancelled, and has not run since to give up its place
                self._give_back(host)
            else:
                turn.set_result(None)

    def _next(self) -> tuple[Hashable, Address] | None:
        """The host whose turn it is, and its kind; its slot is taken."""
        for kind, hosts in self.waiting.items():
            if self._taken[kind] < self._together:
                for host in hosts:
                    if self._take(host, kind):
                        return kind, host
        return None

    def _take(self, host: Address, kind: Hashable) -> bool:
        kind = self._taken_as.get(host, kind)  # as whose its other slots count
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
