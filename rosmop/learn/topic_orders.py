"""Which topics follow each other: alternations, answers and preconditions with their times.

For each two topics: the time from a message of the second back to the last one of the first (`back`), the time from the
first unanswered one on (`forth`), and whether they take turns. `by_chance` returns whether chance would give the same.
"""

import math
from collections.abc import Mapping, Sequence

from rosmop.learn.series import HighestValues

MOST_TOPICS = 24
"""The maximum number of topics that are compared with each other: those with the fewest messages."""

_SURE = 1e-6  # probability that chance makes one of all pairs look like an order
_FEWEST = 20  # messages that an order is based on


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
        self._first: int | None = None  # of those that no second has followed
        self._last: int | None = None
        self._seconds = 0  # since the last first
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
        """Whether as many messages would be within the bound of a topic with this rate (1/s) by chance."""
        share = bound * rate
        return share >= 0.5 or count * math.log(max(share, 1e-12)) > math.log(_SURE / max(len(self.pairs), 1))
