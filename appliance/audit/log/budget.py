"""Limit the bytes of audit records that each host causes, by the free space of the disk. No I/O.

1. A host's debt shrinks by `RATE`. Only calls of a host wait that owes more than its own bound, and whose group also
   owes more than the group's part of the free space.
2. A bound that shrinks forgives what it shrank by.
3. On a nearly full disk all bounds are smaller. The last part of the reserve is kept for the robot and for hosts that
   the policy names. Unknown hosts are not charged, but folded.

`DiskParts` divides the free space among the robot and the hosts that the policy names:

1. A group's debt is never charged to another group, and its part depends on the disk only: no host slows another one.
2. Records that wait for the disk are finite too (`_MAX_QUEUED`): beyond that, a group has no part until the log has
   caught up. The robot keeps its part for longer than others.
3. A part that shrinks forgives what it shrank by: records that were cheap when they were made stop no host later.
"""

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from appliance.audit.log.record import AuditRecord
from appliance.base import clock
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import (
    AUDIT_BYTES,
    AUDIT_NAMED_PART,
    AUDIT_RATE,
    AUDIT_RESERVE,
    AUDIT_ROBOT_PART,
    MAX_AUDIT_NAMED,
)

RATE = AUDIT_RATE
"""Bytes per second; divided by `_SCARCE` on a nearly full disk."""

_SCARCE = 8
_RECORD_BYTES = 400  # on disk, with its entries in the indices
_BYTES_PER_CHARACTER = 2  # the text, and its entry in the full-text index
_PAID_EVERY_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 1.0
_MAX_QUEUED = {True: 0.75, False: 0.25}  # of the log's queue, for the robot and for other groups


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

    def lower_all(self, paid: int) -> None:
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
        if group is None or self._queued >= _MAX_QUEUED[group.robot]:
            return None
        return self._owed.get(group, 0) - self._part(group, self._free)

    def _part(self, group: DiskGroup, free: int) -> int:
        if group.robot:
            return free // AUDIT_ROBOT_PART
        free = free if self._retained is None else min(free, self._retained)
        return min(MAX_AUDIT_NAMED, free // AUDIT_NAMED_PART)


def forgiven(owed: int, before: int, bound: int) -> int:
    """Return what is left of a debt when its bound shrinks from `before`."""
    return owed if owed <= bound else max(bound, owed - (before - bound))


def weight(record: AuditRecord) -> int:
    size = len(record.caller_id or "") + len(record.resource or "") + len(record.reason)
    for value in record.detail.values():
        size += len(value if type(value) is str else str(value))
    return _RECORD_BYTES + _BYTES_PER_CHARACTER * size


class Budget:
    """The debts of hosts, for one thread; only `correct` and `room` may be called from several.

    `reserve` has the bounds for the disk's reserve, whose last part is left to hosts that have a part in `parts`.
    """

    def __init__(
        self,
        quota_class: Callable[[str], QuotaClass],
        *,
        bounds: Bounds = AUDIT_BYTES.bounds,
        reserve: Bounds = AUDIT_RESERVE.bounds,
        parts: DiskParts | None = None,
        clock: Callable[[], float] = clock.now,
    ) -> None:
        self.quota_class = quota_class
        self._plenty = bounds
        self._scarce = dataclasses.replace(bounds, host=reserve.host, unknown=reserve.host)
        self._kept = reserve.kept
        self.parts = parts or DiskParts()
        self._clock = clock
        self.owed: Pool[str] = Pool("bytes of audit records to pay off", bounds, quota_class)
        self._paid = clock()
        self._charged: dict[str, int] = {}  # bytes that `owed` does not have yet
        self._charged_bytes = 0
        self._changes: deque[tuple[str, int]] = deque()
        self._within: set[str] = set()  # hosts above their own bound, and within their part when last paid
        self._left: int | None = None
        self._free = 0

    def charge(self, record: AuditRecord) -> None:
        host = record.host
        if host is not None and not record.unknown:
            size = weight(record)
            self._charged[host] = self._charged.get(host, 0) + size
            self._charged_bytes += size

    def correct(self, record: AuditRecord, sign: int) -> None:
        """Charge a summary (1), or return the charge for a record that was only counted (-1)."""
        if record.host is not None and not record.unknown:
            self._changes.append((record.host, sign * weight(record)))

    def room(self, left: int | None, free: int = 0) -> None:
        """Set how many bytes of the reserve are left (None: more than the reserve), and how many of the disk are
        free.
        """
        self._left, self._free = left, free

    def shut_out(self, host: str) -> str:
        """Return why a nearly full disk blocks this host, or an empty string."""
        left = self._left
        if left is None or left >= self._kept or self.parts.has_part(host):
            return ""
        return (
            f"the disk of the audit log has {left} bytes left, which are kept for the robot and for hosts that the"
            " policy names"
        )

    def owing(self, host: str) -> str:
        """Return why calls of this host must wait, or an empty string."""
        if self._left is None and self._is_usual(host):
            return ""
        self._pay()
        reason = self.owed.refusal(host, 0)
        if not reason:
            return ""
        beyond = self.parts.beyond(host)
        if beyond is None:
            return reason
        if beyond > 0:
            return f"{reason}, and its part of the free disk space is used up"
        self._within.add(host)
        return ""

    def pause(self, host: str) -> float:
        if not self.owing(host):
            return 0.0
        over, beyond = self.owed.held(host) - self.owed.bounds.host, self.parts.beyond(host)
        if beyond is not None:
            over = min(over, beyond)
        return min(_LONGEST_PAUSE_SECONDS, max(_PAID_EVERY_SECONDS, over / self._pace))

    def _is_usual(self, host: str) -> bool:
        recent = self._clock() - self._paid < _PAID_EVERY_SECONDS
        if recent and host in self._within:
            return True
        if self._changes:
            return False
        if not (self.owed.held(host) or host in self._charged):
            return True
        return recent and self.owed.total + self._charged_bytes <= self._plenty.host

    @property
    def _pace(self) -> int:
        return RATE if self._left is None else RATE // _SCARCE

    def _pay(self) -> None:
        self._forgive()
        charged, self._charged, self._charged_bytes = self._charged, {}, 0
        while self._changes:
            host, change = self._changes.popleft()
            charged[host] = charged.get(host, 0) + change
        for host, change in charged.items():
            if change > 0:
                self.owed.charge(host, change)
            else:
                self._lower(host, -change)
            self.parts.charge(host, change)
        now = self._clock()
        if now - self._paid >= _PAID_EVERY_SECONDS:
            paid, self._paid = int((now - self._paid) * self._pace), now
            self._within.clear()
            for host, _owed in list(self.owed.holders()):
                self._lower(host, paid)
            self.parts.lower_all(paid)

    def _forgive(self) -> None:
        bounds, before = self._plenty if self._left is None else self._scarce, self.owed.bounds
        if bounds.host < before.host:
            for host, owed in list(self.owed.holders()):
                self._lower(host, owed - forgiven(owed, before.host, bounds.host))
        self.owed.bounds = bounds
        self.parts.resize(self._free)

    def _lower(self, host: str, amount: int) -> None:
        self.owed.give_back(host, min(amount, self.owed.held(host)))
