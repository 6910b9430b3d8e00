"""How much of a flow may pass: what a limit of the policy allows, and no more. No I/O; time is given.

A limit allows messages and bytes, evenly, up to the amount of `BURST` seconds. A message passes while neither is used
up, also if it is larger than what is left; the messages after it make up for that. So a publisher that keeps to the
limit loses nothing, a large message passes as well, and on average no more passes than is allowed.

What is beyond is dropped, never kept for later: no other connection waits for it.

Several holders share a limit (`Flow.of`): the hosts that publish a topic, the nodes of one host. Invariants:

1. Together they get what the limit allows. Each gets an equal part of it, in its own store; what a full store has no
   room for goes in equal parts to the others (max-min fairness), and once all are full to a common store.
2. A holder takes from its own store first, then from the common one. So one that stays within its equal part loses
   nothing because of another, and what one does not use is there for the others.
3. Only the store of a holder that sent too large a message goes below zero. If the holder leaves, its debt stays in the
   common store, and the flow is kept until all is paid: to come back wins nothing.
"""

from collections.abc import Callable, Iterator
from math import ceil
from typing import Literal
from weakref import WeakValueDictionary

from appliance.channel.messages import UNLIMITED, FlowLimit
from appliance.relay.connections.frames import Batch
from appliance.relay.connections.memory import HostShare

Part = Literal["publisher", "subscriber", "topic"]
"""Whose limit it is."""

BURST = 0.5
"""Seconds' worth of messages that may come at once."""

_FILL_SECONDS = 20e-6  # for each holder: a flow with thousands of them is filled less often
_FEW_FLOWS = 64
_MOST_OWING = 4096  # flows that nobody holds and that are not paid


class _Store:
    """What is left of one unit of a limit (messages or bytes), for each holder and in common."""

    def __init__(self, rate: float, least: float) -> None:
        """`rate` is in a second; `least` is the room that each holder has at least."""
        self.rate = rate
        self._least = least
        self._own: dict[str, float] = {}
        self._common = self._most

    def set(self, rate: float) -> None:
        """The limit is this one from now on; a limit after none begins full."""
        before, self.rate = self.rate, rate
        if not before:
            self._own, self._common = dict.fromkeys(self._own, self._room), self._most
        self._give_back()
        self._common = min(self._common, self._most_common)

    def hold(self, names: "WeakValueDictionary[str, FlowShare]") -> None:
        """These are the holders from now on: one that is new gets its room as far as the common store has it."""
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
        """Divide what the limit allows in so many seconds."""
        left, room = seconds * self.rate, self._room
        for rank, name in enumerate(sorted(self._own, key=self._own.__getitem__, reverse=True)):
            given = min(left / (len(self._own) - rank), room - self._own[name])
            self._own[name] += given
            left -= given
        self._common = min(self._common + left, self._most_common)

    def left(self, name: str) -> float:
        """What this holder may use now."""
        return self._own[name] + max(self._common, 0.0)

    def take(self, name: str, amount: float) -> None:
        """This holder has used so much."""
        own = min(amount, max(self._own[name], 0.0))
        common = min(amount - own, max(self._common, 0.0))
        self._common -= common
        self._own[name] -= amount - common

    @property
    def full(self) -> bool:
        """Whether nothing that was used is missing any more."""
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
        """What is beyond the room of a holder is common."""
        room = self._room
        for name, own in self._own.items():
            if own > room:
                self._common += own - room
                self._own[name] = room


class Flow:
    """What all holders of one limit may send: the publishers of a topic, the names of a host."""

    def __init__(self, limit: FlowLimit, now: float) -> None:
        self._limit = limit
        self._messages, self._bytes = _Store(limit.messages, 1.0), _Store(limit.bytes, 0.0)
        self._filled = now
        self._shares: WeakValueDictionary[str, FlowShare] = WeakValueDictionary()
        self._holders = 0

    def set(self, limit: FlowLimit, now: float) -> None:
        """There is another limit from now on; what is left of the old one counts."""
        if limit != self._limit:
            self._fill(now)
            self._limit = limit
            self._messages.set(limit.messages)
            self._bytes.set(limit.bytes)

    def of(self, name: str) -> "FlowShare":
        """The part of this holder; it counts as one for as long as the part is kept."""
        share = self._shares.get(name)
        if share is None:
            share = self._shares[name] = FlowShare(self, name)
            self._hold()
        return share

    def room(self, name: str, batch: Batch, most: int, now: float) -> int:
        """How many of the first `most` messages of a batch of this holder may pass."""
        self._fill(now)
        if self._limit.messages:
            most = min(most, max(0, ceil(self._messages.left(name))))
        return batch.within(self._bytes.left(name), most) if self._limit.bytes else most

    def take(self, name: str, batch: Batch) -> None:
        """These of this holder have passed."""
        if self._limit.messages:
            self._messages.take(name, batch.messages)
        if self._limit.bytes:
            self._bytes.take(name, len(batch.view))

    @property
    def held(self) -> bool:
        """Whether anybody holds a part of it."""
        return bool(self._shares)

    def paid(self, now: float) -> bool:
        """Whether nothing that was used is missing any more: a flow that begins now is the same."""
        self._fill(now)
        return self._messages.full and self._bytes.full

    def _fill(self, now: float) -> None:
        if len(self._shares) != self._holders:
            self._hold()
        passed = now - self._filled
        if passed >= self._holders * _FILL_SECONDS:
            self._filled = now
            self._messages.fill(passed)
            self._bytes.fill(passed)

    def _hold(self) -> None:
        self._holders = len(self._shares)
        self._messages.hold(self._shares)
        self._bytes.hold(self._shares)


class FlowShare:
    """The part of one holder in a flow."""

    __slots__ = ("__weakref__", "_flow", "_name")

    def __init__(self, flow: Flow, name: str) -> None:
        self._flow = flow
        self._name = name

    def room(self, batch: Batch, most: int, now: float) -> int:
        """How many of the first `most` messages of a batch may pass."""
        return self._flow.room(self._name, batch, most, now)

    def take(self, batch: Batch) -> None:
        """These have passed."""
        self._flow.take(self._name, batch)


class Flows:
    """The flows that several connections share, by name: of a topic, of a host's publishers, of a subscriber.

    Each is kept while a connection holds a part of it, and until all that was used of it is paid for.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.flows: dict[tuple[str, ...], Flow] = {}
        self._most = _FEW_FLOWS

    def of(self, limit: FlowLimit, *names: str, holder: str = "") -> FlowShare | None:
        """The part of a holder in the flow of these names, under this limit from now on; None without a limit."""
        flow = self.flows.get(names)
        if limit == UNLIMITED:
            self.flows.pop(names, None)
            if flow is not None:
                flow.set(limit, self._clock())
            return None
        if flow is None:
            self._forget()
            flow = self.flows[names] = Flow(limit, self._clock())
        flow.set(limit, self._clock())
        return flow.of(holder)

    def _forget(self) -> None:
        """Forget the flows that nobody holds and that are paid, each time their number has doubled; then the oldest."""
        if len(self.flows) < self._most:
            return
        now = self._clock()
        unheld = [names for names, flow in self.flows.items() if not flow.held]
        owing = [names for names in unheld if not self.flows[names].paid(now)]
        for names in set(unheld).difference(owing[-_MOST_OWING:]):
            del self.flows[names]
        self._most = max(_FEW_FLOWS, 2 * len(self.flows))


class PublicationFlow:
    """What limits let pass of one publication: its host's on this topic, and that of the topic.

    `dropped(part, messages, size)` hears what they did not. The last message of a latching publisher is not lost for
    good: it waits (`later`) until it may pass, unless another one comes.
    """

    def __init__(self, share: HostShare, dropped: Callable[[Part, int, int], None]) -> None:
        self._share = share
        self._dropped = dropped
        self._own: FlowShare | None = None
        self._together: FlowShare | None = None
        self._waiting: Batch | None = None
        self.limits = False
        """Whether there are any."""

    def set(self, own: FlowShare | None, together: FlowShare | None) -> None:
        """These are the parts of limits from now on: of its host's, and of its topic's."""
        self._own = own
        self._together = together
        self.limits = self._own is not None or together is not None

    def passing(self, batch: Batch, now: float, *, latching: bool) -> Batch | None:
        """The first messages of a batch, as many as may pass; None when none may."""
        self.forget()
        part = batch
        for name, flow in self._flows():
            count = flow.room(part, part.messages, now)
            if count < part.messages:
                part = self._cut(part, count, name)
        if part.messages < batch.messages and latching:
            self._wait(batch)
        if not part.messages:
            return None
        self._take(part)
        return part

    def later(self, now: float) -> Batch | None:
        """The message that waits, when it may pass now."""
        waiting = self._waiting
        if waiting is None:
            return None
        if not all(flow.room(waiting, 1, now) for _, flow in self._flows()):
            return None
        self.forget()
        self._take(waiting)
        return waiting

    def forget(self) -> None:
        """Forget what waits."""
        if self._waiting is not None:
            self._share.add(-len(self._waiting.view))
            self._waiting = None

    def _cut(self, batch: Batch, count: int, part: Part) -> Batch:
        head = batch.head(count)
        self._dropped(part, batch.messages - count, len(batch.view) - len(head.view))
        return head

    def _take(self, batch: Batch) -> None:
        for _, flow in self._flows():
            flow.take(batch)

    def _flows(self) -> Iterator[tuple[Part, FlowShare]]:
        if self._own is not None:
            yield "publisher", self._own
        if self._together is not None:
            yield "topic", self._together

    def _wait(self, batch: Batch) -> None:
        size = len(batch.view) - batch.find_last()
        if not self._share.refusal(size):
            self._share.add(size)
            last = batch.keep_last()
            last.first = batch.first + batch.messages - 1
            self._waiting = last
