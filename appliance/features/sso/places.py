"""Limit the sign-ons of each address, and those that run at once.

1. A sign-on counts from its beginning until it succeeds; a failed one counts too. So many people behind one address
   can sign in, and an unknown host can neither begin nor try many.
2. While all places are taken, the next free one goes to the address that has fewest, then to the one that has used
   them least. Without a queue, no address waits.
"""

import asyncio
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from appliance.api.front.problems import ProblemError, too_many
from appliance.api.front.rates import Buckets, peer_key
from appliance.base import clock

MOST_AT_ONCE = 6  # of the 16 requests that may wait for other processes
MOST_WAITING = 64
WAITING_SECONDS = 10.0
_REMEMBERED = 1024  # addresses


class SignOnRates:
    """The sign-ons that each address has begun and not completed, and those that failed."""

    def __init__(self, per_minute: int) -> None:
        self._begun, self._failed = (Buckets(per_minute / 60, per_minute) for _ in range(2))

    def begin(self, peer: str) -> None:
        self.require_no_failures(peer)
        if seconds := self._begun.take(peer, clock.now()):
            raise too_many("too-many-failures", "too many sign-ins from this host are not completed", seconds)

    def require_no_failures(self, peer: str) -> None:
        if seconds := self._failed.wait(peer, clock.now()):
            raise too_many("too-many-failures", "too many sign-ins from this host failed", seconds)

    def failed(self, peer: str) -> None:
        self._failed.take(peer, clock.now())

    def succeeded(self, began_at: str) -> None:
        self._begun.give_back(began_at, clock.now())


class SignOnPlaces:
    """The sign-ons that run at once."""

    def __init__(self) -> None:
        self._running: Counter[str] = Counter()
        self._waiting: list[tuple[str, asyncio.Future[None]]] = []  # oldest first
        self._used: OrderedDict[str, float] = OrderedDict()  # seconds of each address

    @asynccontextmanager
    async def place(self, peer: str) -> AsyncIterator[None]:
        key = peer_key(peer)
        if self._running.total() < MOST_AT_ONCE:
            self._running[key] += 1
        else:
            await self._wait(key)
        began = clock.now()
        try:
            yield
        finally:
            self._leave(key, clock.now() - began)

    async def _wait(self, key: str) -> None:
        self._make_room(key)
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((key, turn))
        try:
            async with asyncio.timeout(WAITING_SECONDS):
                await turn
        except BaseException as error:
            if turn.done() and not turn.cancelled() and turn.exception() is None:
                self._leave(key, 0.0)  # it had just got the place
            if isinstance(error, TimeoutError):
                raise _busy() from None
            raise
        finally:
            self._waiting = [one for one in self._waiting if one[1] is not turn]

    def _make_room(self, key: str) -> None:
        if len(self._waiting) < MOST_WAITING:
            return
        waiting = Counter(one for one, _ in self._waiting)
        other, most = waiting.most_common(1)[0]
        if most <= waiting[key] + 1:
            raise _busy()
        turn = next(turn for one, turn in reversed(self._waiting) if one == other)
        if not turn.done():
            turn.set_exception(_busy())

    def _leave(self, key: str, seconds: float) -> None:
        self._running[key] -= 1
        self._running += Counter()  # without those that have none
        self._used[key] = self._used.pop(key, 0.0) + seconds
        if len(self._used) > _REMEMBERED:
            self._used.popitem(last=False)
        present = [(one, turn) for one, turn in self._waiting if not turn.done()]
        if not present:
            return
        next_key, turn = min(present, key=lambda one: (self._running[one[0]], self._used.get(one[0], 0.0)))
        self._running[next_key] += 1
        turn.set_result(None)


def _busy() -> ProblemError:
    return ProblemError(503, "busy", "too many people sign in at once: try again", retry_after=5)
