"""Messages that came while nobody was there to have them: for subscribers that are on their way.

With a monitor on its topic a publisher has a connection, and counts one subscriber, before the real one is there. A
publisher that waits for its subscriber and then says one thing would say it to the monitor alone. So what came in the
last `SECONDS` is kept while nobody is served, and for as long again after the first one is, and given to whoever comes
in that time: a plain subscriber would have been connected when the publisher spoke. What is older is not given: a
command must not be carried out long after it was meant. Latching publishers need none of this.

Invariants: what is kept is without a gap up to the latest message, so a subscriber that gets it misses nothing after
it. Nobody gets it twice: who connects again under the same name in that time gets what comes then.
"""

from collections import deque

from appliance.relay.frames import Batch, MemoryBudget

SECONDS = 1.0
_MESSAGES = 200
_BYTES = 1 << 20


class Recent:
    """The latest messages of one topic; times are seconds of the relay's clock."""

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._batches: deque[tuple[float, Batch]] = deque()
        self._messages = 0
        self._bytes = 0
        self._until: float | None = None
        self._given: set[str] = set()

    def give(self, caller_id: str, now: float) -> list[Batch]:
        """What a subscriber that is served now is given, the oldest first; who comes soon after gets it as well."""
        self.forget_old(now)
        again, over = caller_id in self._given, self.over(now)
        self._given.add(caller_id)
        if self._until is None:
            self._until = now + SECONDS
        return [] if again or over else [batch for _came, batch in self._batches]

    def over(self, now: float) -> bool:
        """Whether everybody who was on his way has had his time."""
        return self._until is not None and now > self._until

    def add(self, batch: Batch, now: float) -> None:
        """Messages have come; one batch that is too large leaves nothing to be kept."""
        size = len(batch.view)
        if size > _BYTES or batch.messages > _MESSAGES or self._budget.exhausted:
            self.clear()
            return
        self._batches.append((now, Batch(batch.keep(), batch.messages, batch.last, owned=True)))
        self._count(batch.messages, size)
        self.forget_old(now)

    def clear(self) -> None:
        """Keep nothing."""
        self._batches.clear()
        self._count(-self._messages, -self._bytes)

    def forget_old(self, now: float) -> None:
        """What is too old, or beyond the bounds, takes no memory any more."""
        while self._batches and (
            self._batches[0][0] < now - SECONDS or self._messages > _MESSAGES or self._bytes > _BYTES
        ):
            _came, batch = self._batches.popleft()
            self._count(-batch.messages, -len(batch.view))

    def _count(self, messages: int, size: int) -> None:
        self._messages += messages
        self._bytes += size
        self._budget.used += size
