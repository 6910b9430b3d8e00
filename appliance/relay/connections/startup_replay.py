"""Keep the first messages of a new publisher for subscribers that are about to connect.

A monitored topic connects to its publisher before the first real subscriber does, and the publisher sees a subscriber.
A publisher that waits for a subscriber and then sends one message would send it to the monitor alone. Therefore its
first messages are kept for `SECONDS`, and each subscriber that connects in that time gets them. In plain ROS that
subscriber would have been connected in time.

Invariants:
- Streams are not kept. If a publisher still sends `SPEECH` seconds after its first message, all kept messages are
  dropped. New subscribers then get only later messages, as in plain ROS: a command must not be executed late.
- The kept messages have no gap up to the latest one.
- A subscriber that reconnects under the same name does not get the kept messages again.
"""

from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HostMemory

APPEARED = 5.0
"""Seconds after which a publisher no longer counts as new."""

SECONDS = 1.0
SPEECH = 0.25
_MESSAGES = 200
_BYTES = 1 << 20


class StartupReplay:
    """The first messages of one topic, kept from `began` on; times are seconds of the relay's clock."""

    def __init__(self, share: HostMemory, began: float) -> None:
        self._share = share
        self._until = began + APPEARED
        self._first: float | None = None
        self._batches: list[Batch] = []
        self._messages = 0
        self._bytes = 0
        self._given: set[str] = set()

    def over(self, now: float) -> bool:
        return now > self._until

    def add(self, batch: Batch, now: float) -> bool:
        """Keep messages; return False if there are too many, they come too late, or memory is short."""
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
        """Return the messages for a new subscriber, the oldest first."""
        again = caller_id in self._given
        self._given.add(caller_id)
        return [] if again else self._batches

    def forget(self) -> None:
        self._share.add(-self._bytes)
        self._batches, self._bytes = [], 0
