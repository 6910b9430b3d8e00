"""One publisher of a topic with a rank, as its relayed topic uses it."""

from collections.abc import Callable, Mapping

from appliance.relay.ranked_topic import RankedTopic
from appliance.relay.transport.frames import Batch
from appliance.relay.velocity_zero import moves_of

_JUDGED = 500  # more than a relay that paused for 5 s reads of a topic of 100 messages a second at once


class RankedPublication:
    """The publisher `key` of a ranked topic. Its type is known once it is `opened`."""

    def __init__(self, topic: RankedTopic, key: str) -> None:
        self._topic = topic
        self._key = key
        self._moves: Callable[[memoryview], bool] = moves_of({})

    def opened(self, header: Mapping[str, str], now: float) -> None:
        self._moves = moves_of(header)
        self._topic.opened(self._key, now)

    def closed(self, now: float) -> None:
        self._topic.lose(self._key, now)

    def hears(self, now: float) -> bool:
        return self._topic.hears(self._key, now)

    def passing(self, batch: Batch, now: float) -> Batch:
        """Return the messages after the last one that does not pass. Earlier zeros are dropped with it.

        Only the last `_JUDGED` messages are judged: the earlier ones pass if the publisher was heard before.
        """
        early = max(0, batch.messages - _JUDGED)
        dropped = 0 if self.hears(now) else early
        for number, frame in enumerate(batch.frames(early), early + 1):
            if not self._topic.passes(self._key, moves=self._moves(frame[4:]), now=now):
                dropped = number
        if not dropped:
            return batch
        left = batch.messages - dropped
        return batch.tail(left) if left else Batch(batch.view[:0], 0, None)
