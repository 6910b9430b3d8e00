"""Count each host's holdings of a bounded resource, oldest first."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

Thing = TypeVar("Thing", bound=Hashable)

Holder = Hashable | None
"""None if holders are not distinguished."""


HolderOf = Callable[[int], Holder]
"""Names the holder that is charged for the slices of a source (`MessageSender.source`)."""


def no_holder(_source: int) -> Holder:
    return None


class Quota(Generic[Thing]):
    """The holdings of a bounded resource, oldest first.

    A holder may have at most as much as is still free, so later holders find room and earlier ones lose nothing. The
    holder None is limited only by the total.
    """

    def __init__(self, whole: int) -> None:
        self.whole = whole
        self.total = 0
        self._of: dict[Holder, OrderedDict[Thing, None]] = {}

    def held_by(self, holder: Holder) -> int:
        return len(self._of.get(holder, ()))

    def fits(self, holder: Holder, more: int) -> bool:
        left = self.whole - self.total - more
        return left >= 0 and (holder is None or self.held_by(holder) + more <= max(left, 1))

    def take(self, holder: Holder, thing: Thing) -> None:
        self._of.setdefault(holder, OrderedDict())[thing] = None
        self.total += 1

    def give_back(self, holder: Holder, thing: Thing) -> None:
        mine = self._of[holder]
        del mine[thing]
        self.total -= 1
        if not mine:
            del self._of[holder]

    def oldest(self, holder: Holder) -> Thing:
        return next(iter(self._of[holder]))

    def all(self) -> Iterator[tuple[Holder, Thing]]:
        return ((holder, thing) for holder, things in self._of.items() for thing in things)

    def clear(self) -> None:
        self._of.clear()
        self.total = 0

    def take_over(self, other: "Quota[Thing]") -> None:
        self._of, self.total = other._of, other.total
