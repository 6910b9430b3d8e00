"""Find which topics follow each other: alternations, answers and preconditions, with their times.

Each pair has the time from a message of the second topic back to the last message of the first (`back`), the
time from the first unanswered message to its answer (`forth`), and whether the topics take turns.
"""

import math
from collections.abc import Mapping, Sequence

import msgspec

from rosmop.learn.series import HighestValues, merged_rows

MAX_TOPICS = 24
"""The topics with the fewest messages are compared, because a command says more than a regular beat."""

_SURE = 1e-6  # the probability that any of all pairs looks like an order by chance
_FEWEST = 20  # the minimum number of messages for an order


class TopicPair(msgspec.Struct):
    """The order of the messages of one topic relative to another."""

    back: HighestValues = msgspec.field(default_factory=HighestValues)
    forth: HighestValues = msgspec.field(default_factory=HighestValues)
    answered: int = 0
    requires: bool = True
    turns: bool = True
    first: int | None = None
    last: int | None = None
    seconds: int = 0
    started: bool = False

    def end(self) -> None:
        self.first = self.last = None
        self.seconds, self.started = 0, False

    def merge(self, other: "TopicPair") -> "TopicPair":
        return TopicPair(
            self.back.merge(other.back), self.forth.merge(other.forth), self.answered + other.answered,
            self.requires and other.requires, self.turns and other.turns,
        )  # fmt: skip

    def add_first(self, time: int) -> None:
        if self.started and self.seconds != 1:
            self.turns = False
        self.started, self.seconds = True, 0
        self.last = time
        if self.first is None:
            self.first = time

    def add_second(self, time: int, window: int) -> None:
        if self.last is None:
            self.requires = False
            return
        self.seconds += 1
        self.turns &= self.seconds == 1
        self.back.add((time - self.last) / 10**9, window)
        if self.first is not None:
            self.forth.add((time - self.first) / 10**9, window)
            self.answered += 1
            self.first = None


class TopicOrders:
    """All pairs of some topics."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        names = sorted(
            (name for name in counts if counts[name] >= _FEWEST), key=lambda name: (counts[name], name)
        )
        self.names: Sequence[str] = names[:MAX_TOPICS]
        self.left_out: Sequence[str] = names[MAX_TOPICS:]
        self.pairs = {(a, b): TopicPair() for a in self.names for b in self.names if a != b}

    def add_recordings(self, pairs: Mapping[tuple[str, str], TopicPair]) -> None:
        self.pairs = merged_rows(self.pairs, pairs, TopicPair.merge)

    def by_chance(self, bound: float, rate: float, count: int) -> bool:
        """Whether `count` messages would be within `bound` seconds of another topic's (`rate`, 1/s) by chance alone."""
        share = bound * rate
        return share >= 0.5 or count * math.log(max(share, 1e-12)) > math.log(_SURE / max(len(self.pairs), 1))


class TopicOrderReader:
    """Observes the pairs of some topics in one recording."""

    def __init__(self, names: Sequence[str]) -> None:
        self.pairs = {(a, b): TopicPair() for a in names for b in names if a != b}
        self._firsts = {a: [self.pairs[a, b] for b in names if b != a] for a in names}
        self._seconds = {b: [self.pairs[a, b] for a in names if a != b] for b in names}

    def add(self, topic: str, time: int, window: int) -> None:
        for pair in self._seconds.get(topic, ()):
            pair.add_second(time, window)
        for pair in self._firsts.get(topic, ()):
            pair.add_first(time)

    def finish(self) -> dict[tuple[str, str], TopicPair]:
        for pair in self.pairs.values():
            pair.end()
        return self.pairs
