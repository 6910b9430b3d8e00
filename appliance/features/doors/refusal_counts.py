"""Count the refusals of the topics of one client, to disconnect a program that does not read them. No I/O, no clock.

Some libraries show a program no `status`, so it would go on for hours without an effect. They show the reason of a
closing frame. A call that waits for an approval is repeated until the operator answers, so it does not count, and no
client is disconnected while one of its calls waits.
"""

from collections import deque

MOST_REFUSALS = 100
REFUSAL_SECONDS = 30.0
HELD = "held for approval"
"""A call with these words in its reason waits for an operator."""
_HELD_SECONDS = 120.0  # as long as a held call waits
_MOST_TOPICS = 100


class RefusalCounts:
    """The refusals of one client. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}
        self._held_until = 0.0

    def exceeded(self, topic: str, reason: str, now: float) -> bool:
        """Count a refusal of a topic (empty: of a call). Return whether the client must be disconnected."""
        if HELD in reason:
            self._held_until = now + _HELD_SECONDS
            return False
        if not topic:
            return False
        if topic not in self._times and len(self._times) >= _MOST_TOPICS:
            self._times.clear()
        times = self._times.setdefault(topic, deque(maxlen=MOST_REFUSALS))
        times.append(now)
        return len(times) == MOST_REFUSALS and now - times[0] <= REFUSAL_SECONDS and now >= self._held_until
