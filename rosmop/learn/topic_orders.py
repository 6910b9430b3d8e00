"""Find which topics follow each other: alternations, answers and preconditions, with their times.

For each pair of topics, three things are measured: the time from a message of the second topic back to the last message
of the first (`back`); the time from the first unanswered message to its answer (`forth`); and whether the topics take
turns. `by_chance` returns whether chance would give the same result.
"""

import math
from collections.abc import Mapping, Sequence

from rosmop.learn.series import HighestValues

MOST_TOPICS = 24
"""The maximum number of topics that are compared with each other. The topics with the fewest messages are used."""

_SURE = 1e-6  # the probability that any of all pairs looks like an order by chance
_FEWEST = 20  # the minimum number of messages for an order


class TopicPair:
    """The order of the messages of one topic relative to another."""

    def __init__(self) -> None:
        self.back, self.forth = HighestValues(), HighestValues()
        self.answered = 0
        self.requires = True
        self.turns = True
        self.begin()

    def begin(self) -> None:
        """Begin a recording."""
        self._first: int | None = None  # the first message that no second-topic message has followed
        self._last: int | None = None
        self._seconds = 0  # second-topic messages since the last first-topic message
        self._started = False

    def add_first(self, time: int) -> None:
        """Add a message of the first topic."""
        if self._started and self._seconds != 1:
            self.turns = False
        self._started, self._seconds = True, 0
        self._last = time
        if self._first is None:
            self._first = time

    def add_second(self, time: int, window: int) -> None:
        """Add a message of the second topic."""
        if self._last is None:
            self.requires = False
            return
        self._seconds += 1
        self.turns &= self._seconds == 1
        self.back.add((time - self._last) / 10**9, window)
        if self._first is not None:
            self.forth.add((time - self._first) / 10**9, window)
            self.answered += 1
            self._first = None


class TopicOrders:
    """All pairs of some topics."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        names = sorted((name for name in counts if counts[name] >= _FEWEST), key=lambda name: counts[name])
        self.names: Sequence[str] = names[:MOST_TOPICS]
        self.left_out: Sequence[str] = names[MOST_TOPICS:]
        self.pairs = {(a, b): TopicPair() for a in self.names for b in self.names if a != b}
        self._firsts = {a: [self.pairs[a, b] for b in self.names if b != a] for a in self.names}
        self._seconds = {b: [self.pairs[a, b] for a in self.names if a != b] for b in self.names}

    def begin(self) -> None:
        """Begin a recording."""
        for pair in self.pairs.values():
            pair.begin()

    def add(self, topic: str, time: int, window: int) -> None:
        """Add a message."""
        for pair in self._seconds.get(topic, ()):
            pair.add_second(time, window)
        for pair in self._firsts.get(topic, ()):
            pair.add_first(time)

    def by_chance(self, bound: float, rate: float, count: int) -> bool:
        """Whether chance alone would place `count` messages within `bound` seconds of another topic's messages.

        `rate` is the other topic's rate (1/s).
        """
        share = bound * rate
        return share >= 0.5 or count * math.log(max(share, 1e-12)) > math.log(_SURE / max(len(self.pairs), 1))
