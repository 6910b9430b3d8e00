"""What a publisher that has just appeared said first, for subscribers that are on their way.

With a monitor on its topic a publisher has a connection, and counts one subscriber, before the real one is there. A
publisher that waits for its subscriber and then says one thing would say it to the monitor alone. So what it says
first is kept for `SECONDS` and given to every subscriber that comes in that time: in plain ROS it would have been
connected when the publisher spoke.

Invariants:
- Of a stream nothing is kept: a publisher that still speaks `SPEECH` seconds after its first message goes on speaking,
  and a new subscriber gets what it says next, as in plain ROS. A command must not be carried out after it was meant.
- What is kept is without a gap up to the latest message, so a subscriber that gets it misses nothing after it.
- Nobody gets it twice: a subscriber that connects again under the same name in that time gets what comes then.
"""

from appliance.relay.connections.frames import Batch
from appliance.relay.connections.memory import HostShare

APPEARED = 5.0
"""Seconds after which a publisher has not just appeared any more."""

SECONDS = 1.0
SPEECH = 0.25
_MESSAGES = 200
_BYTES = 1 << 20


class FirstWords:
    """The first messages of one topic; times are seconds of the relay's clock, `began` is when it is listened to."""

    def __init__(self, share: HostShare, began: float) -> None:
        self._share = share
        self._until = began + APPEARED
        self._first: float | None = None
        self._batches: list[Batch] = []
        self._messages = 0
        self._bytes = 0
        self._given: set[str] = set()

    def over(self, now: float) -> bool:
        """Whether every subscriber that was on its way has had the time to come."""
        return now > self._until

    def add(self, batch: Batch, now: float) -> bool:
        """Messages have come; False when they are more than first words, and none is to be kept."""
        if self._first is None:
            self._first, self._until = now, now + SECONDS
        self._messages += batch.messages
        size = len(batch.view)
        if (
            now > self._first + SPEECH
            or self._messages > _MESSAGES
            or self._bytes + size > _BYTES
            or self._share.refusal(size)
        ):
            return False
        self._batches.append(Batch(batch.keep(), batch.messages, batch.last, owned=True))
        self._bytes += size
        self._share.add(size)
        return True

    def give(self, caller_id: str) -> list[Batch]:
        """What a subscriber that is served now is given, the oldest first."""
        again = caller_id in self._given
        self._given.add(caller_id)
        return [] if again else self._batches

    def forget(self) -> None:
        """Keep nothing."""
        self._share.add(-self._bytes)
        self._batches, self._bytes = [], 0
