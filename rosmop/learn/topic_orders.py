"""Which topics follow each other: alternations, answers and preconditions with their times.

For each two topics: the time from a message of the second back to the last one of the first (`back`), the time from
the first unanswered one on (`forth`), and whether they take turns. `by_chance` says what chance would do as well.
"""

import math
from collections.abc import Mapping, Sequence

from rosmop.learn.series import Highs

MOST_TOPICS = 24
"""So many topics are compared with each other: those with the fewest messages, as a command says more than a beat."""

_SURE = 1e-6  # how often chance may make one of all the pairs look like an order
_FEWEST = 20  # messages that an order stands on


class Pair:
    """How the messages of one topic lie before those of another."""

    def __init__(self) -> None:
        self.back, self.forth = Highs(), Highs()
        self.answered = 0
        self.requires = True
        self.turns = True
        self.begin()

    def begin(self) -> None:
        """A recording begins."""
        self._first: int | None = None  # of those that no second has followed
        self._last: int | None = None
        self._seconds = 0  # since the last first
        self._started = False

    def see_first(self, time: int) -> None:
        """A message of the first topic."""
        if self._started and self._seconds != 1:
            self.turns = False
        self._started, self._seconds = True, 0
        self._last = time
        if self._first is None:
            self._first = time

    def see_second(self, time: int, window: int) -> None:
        """A message of the second topic."""
        if self._last is None:
            self.requires = False
            return
        self._seconds += 1
        self.turns &= self._seconds == 1
        self.back.see((time - self._last) / 10**9, window)
        if self._first is not None:
            self.forth.see((time - self._first) / 10**9, window)
            self.answered += 1
            self._first = None


class Orders:
    """All pairs of some topics."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        names = sorted((name for name in counts if counts[name] >= _FEWEST), key=lambda name: counts[name])
        self.names: Sequence[str] = names[:MOST_TOPICS]
        self.left_out: Sequence[str] = names[MOST_TOPICS:]
        self.pairs = {(a, b): Pair() for a in self.names for b in self.names if a != b}
        self._firsts = {a: [self.pairs[a, b] for b in self.names if b != a] for a in self.names}
        self._seconds = {b: [self.pairs[a, b] for a in self.names if a != b] for b in self.names}

    def begin(self) -> None:
        """A recording begins."""
        for pair in self.pairs.values():
            pair.begin()

    def see(self, topic: str, time: int, window: int) -> None:
        """Take a message."""
        for pair in self._seconds.get(topic, ()):
            pair.see_second(time, window)
        for pair in self._firsts.get(topic, ()):
            pair.see_first(time)

    def by_chance(self, bound: float, rate: float, count: int) -> bool:
        """Whether so many messages would each be within the bound of a topic with this rate (1/s) by chance, too."""
        share = bound * rate
        return share >= 0.5 or count * math.log(max(share, 1e-12)) > math.log(_SURE / max(len(self.pairs), 1))
