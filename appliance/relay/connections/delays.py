"""How late messages become in the relay: from having been received to having been handed to the subscribers' sockets.

Measured once for a batch and counted for each of its messages, the first of which has waited for the last. What waits
after that, in the queue of a slow subscriber, is not the relay's delay but the subscriber's.
"""

from bisect import bisect_left

from appliance.channel.messages import DELAY_BOUNDS


class Delays:
    """Counts of messages by delay, since they were last taken."""

    __slots__ = ("_counts", "_seconds")

    def __init__(self) -> None:
        self._counts = [0] * (len(DELAY_BOUNDS) + 1)
        self._seconds = 0.0

    def add(self, seconds: float, messages: int) -> None:
        """Count so many messages that became so late."""
        self._counts[bisect_left(DELAY_BOUNDS, seconds)] += messages
        self._seconds += seconds * messages

    def take(self) -> tuple[list[int], float]:
        """The counts (none if nothing was counted) and the sum in seconds; they begin anew."""
        counts, seconds = self._counts, self._seconds
        self._counts, self._seconds = [0] * len(counts), 0.0
        return (counts if any(counts) else []), seconds
