"""How much of a flow may pass: what a limit of the policy allows, and no more. No I/O; time is given.

A limit fills a store of messages and one of bytes, evenly, up to what it allows in `BURST` seconds (one message at
least). A message passes while neither is empty, also if it is more than what is there; that is made up for by those
after it. So a publisher that keeps to the limit loses nothing, a large message passes as well, and on average no more
passes than is allowed.

What is beyond is dropped, never kept for later: nobody else waits for it.
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


class Flow:
    """What one publisher, one subscriber, or all publishers of a topic may send."""

    def __init__(self, limit: FlowLimit, now: float) -> None:
        self._limit = limit
        self._messages = self._most_messages
        self._bytes = self._most_bytes
        self._filled = now

    def set(self, limit: FlowLimit, now: float) -> None:
        """There is another limit from now on; what is left of the old one counts."""
        if limit != self._limit:
            self._fill(now)
            before, self._limit = self._limit, limit
            most_messages, most_bytes = self._most_messages, self._most_bytes
            self._messages = min(self._messages, most_messages) if before.messages else most_messages
            self._bytes = min(self._bytes, most_bytes) if before.bytes else most_bytes

    def room(self, batch: Batch, most: int, now: float) -> int:
        """How many of the first `most` messages of a batch may pass."""
        self._fill(now)
        if self._limit.messages:
            most = min(most, max(0, ceil(self._messages)))
        return batch.within(self._bytes, most) if self._limit.bytes else most

    def take(self, batch: Batch) -> None:
        """These have passed."""
        if self._limit.messages:
            self._messages -= batch.messages
        if self._limit.bytes:
            self._bytes -= len(batch.view)

    @property
    def _most_messages(self) -> float:
        return max(1.0, self._limit.messages * BURST)

    @property
    def _most_bytes(self) -> float:
        return self._limit.bytes * BURST

    def _fill(self, now: float) -> None:
        passed = now - self._filled
        self._filled = now
        self._messages = min(self._most_messages, self._messages + passed * self._limit.messages)
        self._bytes = min(self._most_bytes, self._bytes + passed * self._limit.bytes)


class Flows:
    """The flows that several connections have in common: a subscriber's on one topic, and a topic's.

    Each lives as long as somebody holds it.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.flows: WeakValueDictionary[tuple[str, ...], Flow] = WeakValueDictionary()

    def of(self, limit: FlowLimit, *names: str) -> Flow | None:
        """The flow of these names under this limit from now on; None where there is none to keep."""
        flow = self.flows.get(names)
        if flow is not None:
            flow.set(limit, self._clock())
        elif limit != UNLIMITED:
            flow = self.flows[names] = Flow(limit, self._clock())
        return flow


class PublicationFlow:
    """What limits let pass of one publication: its own, and that of its topic.

    `dropped(part, messages, size)` hears what they did not. The last message of a latching publisher is not lost for
    good: it waits (`later`) until it may pass, unless another one comes.
    """

    def __init__(self, share: HostShare, dropped: Callable[[Part, int, int], None]) -> None:
        self._share = share
        self._dropped = dropped
        self._own: Flow | None = None
        self._together: Flow | None = None
        self._waiting: Batch | None = None
        self.limits = False
        """Whether there are any."""

    def set(self, own: FlowLimit, together: Flow | None, now: float) -> None:
        """These are the limits from now on."""
        if self._own is not None:
            self._own.set(own, now)
        elif own != UNLIMITED:
            self._own = Flow(own, now)
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

    def _flows(self) -> Iterator[tuple[Part, Flow]]:
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
