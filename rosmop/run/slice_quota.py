"""Counts what hosts have of something finite, the oldest first."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

Thing = TypeVar("Thing", bound=Hashable)

Holder = Hashable | None
"""Who has something, as whoever runs the monitors names it; None where nobody is told apart."""


HolderOf = Callable[[int], Holder]
"""Return who is charged for what the messages of a source make (`Sender.source`)."""


def no_holder(_source: int) -> Holder:
    """Charge nobody, where sources are not told apart."""
    return None


class Quota(Generic[Thing]):
    """A holder has no more than is left for all others: whoever comes later finds room, and nobody loses anything for
    them. None is bounded by the whole alone.
    """

    def __init__(self, whole: int) -> None:
        self.whole = whole
        self.total = 0
        self._of: dict[Holder, OrderedDict[Thing, None]] = {}

    def held(self, holder: Holder) -> int:
        """Return how many things the holder has."""
        return len(self._of.get(holder, ()))

    def fits(self, holder: Holder, more: int) -> bool:
        """Whether the holder may have so many more."""
        left = self.whole - self.total - more
        return left >= 0 and (holder is None or self.held(holder) + more <= max(left, 1))

    def take(self, holder: Holder, thing: Thing) -> None:
        """The holder has this."""
        self._of.setdefault(holder, OrderedDict())[thing] = None
        self.total += 1

    def give_back(self, holder: Holder, thing: Thing) -> None:
        """The holder has this no more."""
        mine = self._of[holder]
        del mine[thing]
        self.total -= 1
        if not mine:
            del self._of[holder]

    def oldest(self, holder: Holder) -> Thing:
        """Return what the holder has had for longest."""
        return next(iter(self._of[holder]))

    def all(self) -> Iterator[tuple[Holder, Thing]]:
        """Return all things with their holders, those of each the oldest first."""
        return ((holder, thing) for holder, things in self._of.items() for thing in things)

    def clear(self) -> None:
        """Nobody has anything."""
        self._of.clear()
        self.total = 0

    def take_over(self, other: "Quota[Thing]") -> None:
        """Go on from the counts of another, with the bound of this one."""
        self._of, self.total = other._of, other.total
