"""Whose request is served next: hosts take turns, so that one host's flood costs the others little.

One host has at most its share of the slots; when all are busy, the next goes to the host that waited longest since
its last turn, however many requests another has waiting and however long each of them takes.
"""

import asyncio
from collections import Counter, OrderedDict, deque

from appliance.policy.model import Address


class Turns:
    """Slots for requests being served, at most `per_host` of them for one host; who gets none waits in turn.

    Whenever a slot is free, everybody who waits does so because of his own host's share.
    """

    def __init__(self, slots: int, per_host: int) -> None:
        self._free = slots
        self._per_host = per_host
        self._taken: Counter[Address] = Counter()
        self._waiting: OrderedDict[Address, deque[asyncio.Future[None]]] = OrderedDict()

    async def enter(self, host: Address) -> None:
        """Take a slot, waiting for this host's turn when there is none."""
        if self._free and self._taken[host] < self._per_host:
            self._take(host)
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(host, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.leave(host)
            else:
                self._give_up(host, turn)
            raise

    def leave(self, host: Address) -> None:
        """Give the slot back: the host that waited longest and is within its share gets it."""
        self._free += 1
        self._taken[host] -= 1
        if not self._taken[host]:
            del self._taken[host]
        while (following := self._next()) is not None:
            queue = self._waiting.pop(following)
            turn = queue.popleft()
            if queue:
                self._waiting[following] = queue  # to the end of the line: its next request waits a round
            if not turn.done():  # else its task was cancelled, and has not run since to give up its place
                self._take(following)
                turn.set_result(None)
                return

    def _next(self) -> Address | None:
        return next((one for one in self._waiting if self._taken[one] < self._per_host), None)

    def _take(self, host: Address) -> None:
        self._free -= 1
        self._taken[host] += 1

    def _give_up(self, host: Address, turn: asyncio.Future[None]) -> None:
        queue = self._waiting.get(host)
        if queue is None or turn not in queue:
            return
        queue.remove(turn)
        if not queue:
            del self._waiting[host]
