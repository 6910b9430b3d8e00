"""Keep the first messages of a new publisher for subscribers that are about to connect.

A monitored topic connects to its publisher before the first real subscriber does. A publisher that waits for a
subscriber and then sends one message would send it to the monitor alone.

- Streams are not kept: if a publisher still sends `SPEECH` seconds after its first message, all kept messages are
  dropped. A command must not be executed late.
- The kept messages have no gap up to the latest one.
- A subscriber that reconnects under the same name does not get them again.
"""

from appliance.relay.transport.frames import Batch
from appliance.relay.transport.memory import HeldBytes, HostMemory

APPEARED = 5.0
"""The seconds after which a publisher no longer counts as new."""

SECONDS = 1.0
SPEECH = 0.25
REPLAY_SECONDS = 1.0
"""The time after a connection in which the first messages of a latching publisher are those that it had latched."""

REPLAY_GAP = 0.1
"""The seconds without a message after which the next one is new: a publisher sends all latched ones at once."""

_MESSAGES = 200
_BYTES = 1 << 20


class StartupReplay:
    """The first messages of one topic, whose publisher is new until `fresh_until`, in seconds of the relay's clock."""

    def __init__(self, share: HostMemory, fresh_until: float) -> None:
        self._held = HeldBytes(share)
        self._fresh_until = fresh_until
        self.keeps = False
        """Whether messages are kept, as of the last call of a method with `now`."""
        self._until = 0.0
        self._first: float | None = None
        self._batches: list[Batch] = []
        self._messages = 0
        self._given: set[str] = set()

    def opened(self, now: float, *, alone: bool) -> None:
        self.keeps = alone and now <= self._fresh_until
        self._fresh_until = now - 1  # the next connection is not its first
        self._until = now + APPEARED

    def expire(self, now: float) -> None:
        if self.keeps and now > self._until:
            self.forget()

    def add(self, batch: Batch, now: float) -> None:
        self.expire(now)
        if not self.keeps:
            return
        if self._first is None:
            self._first, self._until = now, now + SECONDS
        self._messages += batch.messages
        size = len(batch.view)
        if (
            now > self._first + SPEECH
            or self._messages > _MESSAGES
            or self._held.size + size > _BYTES
            or self._held.share.refusal(size)
        ):
            self.forget()
            return
        self._batches.append(Batch(batch.keep(), batch.messages, batch.last, owned=True))
        self._held.set(self._held.size + size)

    def give(self, caller_id: str, now: float) -> list[Batch]:
        self.expire(now)
        again = caller_id in self._given
        if self.keeps:
            self._given.add(caller_id)
        return [] if again else self._batches

    def forget(self) -> None:
        self.keeps, self._batches = False, []
        self._held.set(0)


class LatchReplay:
    """Finds the messages that a latching publisher sends again on a connection: a command of that kind is not new.

    The publisher counts as new until `new_until` (seconds of the relay's clock).
    """

    def __init__(self, new_until: float) -> None:
        self._new_until = new_until
        self._until = self._quiet_at = 0.0

    def opened(self, now: float, *, is_latching: bool, may_be_new: bool) -> None:
        is_new = may_be_new and now <= self._new_until
        self._quiet_at = self._until = now + REPLAY_SECONDS if is_latching and not is_new else 0.0
        self._new_until = -1.0  # only the first connection of a new publisher has a new message first

    def is_replay(self, now: float) -> bool:
        """Return whether messages that come now were latched; call this for each read of a connection."""
        if now > self._quiet_at:
            self._until = 0.0
        self._quiet_at = min(self._until, now + REPLAY_GAP)
        return now <= self._quiet_at
