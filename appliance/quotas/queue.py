"""Find the longest waiting member of each quota class, so that a full pool can evict that member."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

from appliance.quotas.pool import QuotaClass

Holder = TypeVar("Holder", bound=Hashable)
Member = TypeVar("Member")
_MOST_MOVED = 64  # the most members that one search moves to the present quota class of their hosts


class Queue(Generic[Holder, Member]):
    """Members of hosts in order of insertion. `quota_class` returns the present quota class of a host."""

    def __init__(self, quota_class: Callable[[Holder], QuotaClass]) -> None:
        self._quota_class = quota_class
        self._lines = {level: OrderedDict[Member, tuple[Holder, float]]() for level in QuotaClass}
        self._line_of: dict[Member, OrderedDict[Member, tuple[Holder, float]]] = {}

    def put(self, member: Member, host: Holder, since: float) -> None:
        self._file(member, host, since, self._quota_class(host))

    def remove(self, member: Member) -> bool:
        line = self._line_of.pop(member, None)
        if line is None:
            return False
        del line[member]
        return True

    def longest(self, quota_class: QuotaClass) -> tuple[Member, Holder, float] | None:
        """Return the longest waiting member of this class, with its host and the start of its wait.

        The present class of the host counts. Return None if no member is found.
        """
        for _ in range(_MOST_MOVED):
            found = next(iter(self._lines[quota_class].items()), None)
            if found is None:
                break
            member, (host, since) = found
            now = self._quota_class(host)
            if now is quota_class:
                return member, host, since
            self._file(member, host, since, now)
        return None

    def __iter__(self) -> Iterator[Member]:
        return iter(list(self._line_of))

    def _file(self, member: Member, host: Holder, since: float, quota_class: QuotaClass) -> None:
        before = self._line_of.get(member)
        if before is not None:
            del before[member]
        line = self._lines[quota_class]
        line[member] = host, since
        self._line_of[member] = line
