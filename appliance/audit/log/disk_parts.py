"""Divide the free space of the audit log's disk among the robot and the hosts that the policy names. No I/O.

1. A group's debt is never charged to another group, and its part depends on the disk only: no host slows another one.
2. Records that wait for the disk are finite too (`_MOST_QUEUED`): beyond that, a group has no part until the log has
   caught up. The robot keeps its part for longer than others.
3. A part that shrinks forgives what it shrank by: records that were cheap when they were made stop no host later.
"""

from collections.abc import Callable
from typing import NamedTuple

from appliance.quotas.table import AUDIT_NAMED_MOST, AUDIT_NAMED_PART, AUDIT_ROBOT_PART

_MOST_QUEUED = {True: 0.75, False: 0.25}  # of the log's queue, for the robot and for other groups


class DiskGroup(NamedTuple):
    """The hosts that share a part of the free space: the robot, or those of an address or network of the policy."""

    name: str
    robot: bool = False


THE_ROBOT = DiskGroup("robot", robot=True)
GroupOf = Callable[[str], DiskGroup | None]
"""Returns the group of a host; None: the host has no part."""


class DiskParts:
    """The debts of groups. `retained` is the size at which the log removes old records; None: it keeps them.

    Only `queue` may be called from another thread.
    """

    def __init__(self, group_of: GroupOf = lambda _host: None, retained: int | None = None) -> None:
        self._group_of = group_of
        self._retained = retained
        self._owed: dict[DiskGroup, int] = {}
        self._free = 0
        self._queued = 0.0

    def has_part(self, host: str) -> bool:
        return self._group_of(host) is not None

    def queue(self, full: float) -> None:
        """Set which part of the log's queue is full."""
        self._queued = full

    def charge(self, host: str, change: int) -> None:
        if (group := self._group_of(host)) is not None:
            self._owed[group] = max(0, self._owed.get(group, 0) + change)

    def pay(self, paid: int) -> None:
        self._owed = {group: owed - paid for group, owed in self._owed.items() if owed > paid}

    def resize(self, free: int) -> None:
        """Set the free bytes of the disk."""
        before, self._free = self._free, free
        if free < before:
            for group, owed in self._owed.items():
                self._owed[group] = forgiven(owed, self._part(group, before), self._part(group, free))

    def beyond(self, host: str) -> int | None:
        """Return how many bytes the host's group owes beyond its part, at most 0 within it; None without a part."""
        group = self._group_of(host)
        if group is None or self._queued >= _MOST_QUEUED[group.robot]:
            return None
        return self._owed.get(group, 0) - self._part(group, self._free)

    def _part(self, group: DiskGroup, free: int) -> int:
        if group.robot:
            return free // AUDIT_ROBOT_PART
        free = free if self._retained is None else min(free, self._retained)
        return min(AUDIT_NAMED_MOST, free // AUDIT_NAMED_PART)


def forgiven(owed: int, before: int, bound: int) -> int:
    """Return what is left of a debt when its bound shrinks from `before`."""
    return owed if owed <= bound else max(bound, owed - (before - bound))
