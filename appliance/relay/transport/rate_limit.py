"""Apply the policy's rate limits, in messages and bytes per second. No I/O; callers pass the time.

A message passes while neither unit is used up; if it is larger than the rest, later messages pay for the excess. This
admits large messages and keeps the average.

1. Each holder of a shared limit gets an equal part, in its own store. When a store is full, its overflow goes to the
   others in equal parts (max-min fairness); when all are full, it goes to a common store.
2. A holder takes from its own store first, then from the common store, so a holder within its part loses nothing
   because of others, and others can use what it leaves.
3. Only a message that was too large makes a store negative. If its holder leaves, the debt stays in the common store
   until it is paid, so reconnecting does not help.
"""

from collections.abc import Callable
from functools import partial
from math import ceil
from typing import Literal
from weakref import WeakValueDictionary

from appliance.channel.messages import UNLIMITED, FlowLimit
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HeldBytes, HostMemory

Part = Literal["publisher", "subscriber", "topic"]

BURST = 0.5
"""The burst that may come at once, in seconds of the rate."""

_FILL_SECONDS = 20e-6  # between two fills, for each holder: a limit with many holders is filled less often
_FEW_FLOWS = 64
_MAX_OWING = 4096  # limits without holders whose debt is not paid


class _Store:
    """The unused amount of one unit (messages or bytes) of a limit, for each holder and in common."""

    def __init__(self, rate: float, least: float) -> None:
        """`rate` is per second; each holder's store has room for at least `least`."""
        self.rate = rate
        self._least = least
        self._own: dict[str, float] = {}
        self._common = self._most

    def set(self, rate: float) -> None:
        before, self.rate = self.rate, rate
        if not before:
            self._own, self._common = dict.fromkeys(self._own, self._room), self._most
        self._give_back()
        self._common = min(self._common, self._most_common)

    def hold(self, names: "WeakValueDictionary[str, RateAllowance]") -> None:
        for name in [name for name in self._own if name not in names]:
            self._common += self._own.pop(name)
        new = [name for name in names if name not in self._own]
        self._own.update(dict.fromkeys(new, 0.0))
        self._give_back()
        for name in new:
            self._own[name] = max(0.0, min(self._room, self._common))
            self._common -= self._own[name]
        self._common = min(self._common, self._most_common)

    def fill(self, seconds: float) -> None:
        left, room = seconds * self.rate, self._room
        for rank, name in enumerate(sorted(self._own, key=self._own.__getitem__, reverse=True)):
            given = min(left / (len(self._own) - rank), room - self._own[name])
            self._own[name] += given
            left -= given
        self._common = min(self._common + left, self._most_common)

    def balance(self, name: str) -> float:
        return self._own[name] + max(self._common, 0.0)

    def take(self, name: str, amount: float) -> None:
        own = min(amount, max(self._own[name], 0.0))
        common = min(amount - own, max(self._common, 0.0))
        self._common -= common
        self._own[name] -= amount - common

    @property
    def full(self) -> bool:
        return not self.rate or (
            self._common >= self._most_common and all(own >= self._room for own in self._own.values())
        )

    @property
    def _most(self) -> float:
        return max(self.rate * BURST, self._least * (2 * len(self._own) if len(self._own) > 1 else 1))

    @property
    def _room(self) -> float:
        return self._most / (2 * max(1, len(self._own)))

    @property
    def _most_common(self) -> float:
        return self._most / 2 if self._own else self._most

    def _give_back(self) -> None:
        room = self._room
        for name, own in self._own.items():
            if own > room:
                self._common += own - room
                self._own[name] = room


class SharedRateLimit:
    """A limit with several holders: the publishers of a topic, the names of a host."""

    def __init__(self, limit: FlowLimit, now: float) -> None:
        self._limit = limit
        self.messages, self.bytes = _Store(limit.messages, 1.0), _Store(limit.bytes, 0.0)
        self._filled = now
        self._shares: WeakValueDictionary[str, RateAllowance] = WeakValueDictionary()
        self._holders = 0

    def set(self, limit: FlowLimit, now: float) -> None:
        """Change the limit; the unused amount carries over."""
        if limit != self._limit:
            self.fill(now)
            self._limit = limit
            self.messages.set(limit.messages)
            self.bytes.set(limit.bytes)

    def of(self, name: str) -> "RateAllowance":
        """Return the allowance of a name, which counts as a holder while the allowance is referenced."""
        share = self._shares.get(name)
        if share is None:
            share = self._shares[name] = RateAllowance(self, name)
            self._hold()
        return share

    @property
    def held(self) -> bool:
        return bool(self._shares)

    def is_paid(self, now: float) -> bool:
        """Return whether everything used has been refilled, so that a new limit would not differ."""
        self.fill(now)
        return self.messages.full and self.bytes.full

    def fill(self, now: float) -> None:
        if len(self._shares) != self._holders:
            self._hold()
        passed = now - self._filled
        if passed >= self._holders * _FILL_SECONDS:
            self._filled = now
            self.messages.fill(passed)
            self.bytes.fill(passed)

    def _hold(self) -> None:
        self._holders = len(self._shares)
        self.messages.hold(self._shares)
        self.bytes.hold(self._shares)


class RateAllowance:
    """One holder's part of a shared rate limit."""

    __slots__ = ("__weakref__", "_flow", "_name")

    def __init__(self, flow: SharedRateLimit, name: str) -> None:
        self._flow = flow
        self._name = name

    def room(self, batch: Batch, now: float) -> int:
        """Return how many messages of a batch may pass now."""
        flow, most = self._flow, batch.messages
        flow.fill(now)
        if flow.messages.rate:
            most = min(most, max(0, ceil(flow.messages.balance(self._name))))
        return batch.within(flow.bytes.balance(self._name), most) if flow.bytes.rate else most

    def cut(self, batch: Batch, now: float, dropped: Callable[[int, int], None]) -> Batch:
        """Return the messages that may pass now; `dropped` gets the number of the others, and their bytes."""
        count = self.room(batch, now)
        if count == batch.messages:
            return batch
        head = batch.head(count)
        dropped(batch.messages - count, len(batch.view) - len(head.view))
        return head

    def take(self, batch: Batch) -> None:
        if self._flow.messages.rate:
            self._flow.messages.take(self._name, batch.messages)
        if self._flow.bytes.rate:
            self._flow.bytes.take(self._name, len(batch.view))


class RateLimits:
    """The limits that several connections share, by name: for a topic, a host's publishers, or a subscriber."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.flows: dict[tuple[str, ...], SharedRateLimit] = {}
        self._most = _FEW_FLOWS

    def of(self, limit: FlowLimit, *names: str, holder: str = "") -> RateAllowance | None:
        flow = self.flows.get(names)
        if limit == UNLIMITED:
            self.flows.pop(names, None)
            if flow is not None:
                flow.set(limit, self._clock())
            return None
        if flow is None:
            self._forget()
            flow = self.flows[names] = SharedRateLimit(limit, self._clock())
        flow.set(limit, self._clock())
        return flow.of(holder)

    def _forget(self) -> None:
        """Forget unheld limits (refilled ones first) each time the number of limits has doubled."""
        if len(self.flows) < self._most:
            return
        now = self._clock()
        unheld = [names for names, flow in self.flows.items() if not flow.held]
        owing = [names for names in unheld if not self.flows[names].is_paid(now)]
        for names in set(unheld).difference(owing[-_MAX_OWING:]):
            del self.flows[names]
        self._most = max(_FEW_FLOWS, 2 * len(self.flows))


class PublicationRateLimit:
    """The limit of a publication's host on its topic, and the limit of the topic.

    The last message of a latching publisher is not lost: it waits (`later`) until it may pass, or the next message
    comes.
    """

    def __init__(self, share: HostMemory, dropped: Callable[[Part, int, int], None]) -> None:
        self._held = HeldBytes(share)
        self._dropped = dropped
        self._waiting: Batch | None = None
        self.limits: dict[Part, RateAllowance] = {}

    def set(self, own: RateAllowance | None, together: RateAllowance | None) -> None:
        limits: dict[Part, RateAllowance | None] = {"publisher": own, "topic": together}
        self.limits = {part: limit for part, limit in limits.items() if limit is not None}

    def passing(self, batch: Batch, now: float, *, latching: bool) -> Batch:
        self.forget()
        part = batch
        for name, limit in self.limits.items():
            part = limit.cut(part, now, partial(self._dropped, name))
        if part.messages < batch.messages and latching:
            self._wait(batch)
        return self._take(part)

    def later(self, now: float) -> Batch | None:
        waiting = self._waiting
        if waiting is None or not all(limit.room(waiting, now) for limit in self.limits.values()):
            return None
        self.forget()
        return self._take(waiting)

    def forget(self) -> None:
        self._waiting = None
        self._held.set(0)

    def _take(self, batch: Batch) -> Batch:
        for limit in self.limits.values():
            limit.take(batch)
        return batch

    def _wait(self, batch: Batch) -> None:
        size = len(batch.view) - batch.find_last()
        if not self._held.share.refusal(size):
            self._held.set(size)
            self._waiting = batch.keep_last()
            self._waiting.first = batch.first + batch.messages - 1
