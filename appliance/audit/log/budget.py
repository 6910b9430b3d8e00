"""Limit the bytes of audit records that each host causes over time, and more strictly on a nearly full disk. No I/O.

A host's debt shrinks by `RATE`, and only the calls of a host above its quota wait. The last part of the disk's
reserve is kept for the robot and for hosts that the policy names. Unknown hosts are not charged, but folded.
"""

import dataclasses
from collections import deque
from collections.abc import Callable

from appliance.audit.log.record import AuditRecord
from appliance.base import clock
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import AUDIT_BYTES, AUDIT_RESERVE

RATE = 64 << 10
"""Bytes per second; divided by `_SCARCE` on a nearly full disk."""

_SCARCE = 8
_RECORD_BYTES = 400  # on disk, with its entries in the indices
_BYTES_PER_CHARACTER = 2  # the text, and its entry in the full-text index
_PAID_EVERY_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 1.0


def weight(record: AuditRecord) -> int:
    size = len(record.caller_id or "") + len(record.resource or "") + len(record.reason)
    for value in record.detail.values():
        size += len(value if type(value) is str else str(value))
    return _RECORD_BYTES + _BYTES_PER_CHARACTER * size


class Budget:
    """The debts of hosts, for one thread; only `correct` and `room` may be called from several.

    `reserve` has the bounds for the disk's reserve, whose last part is left to hosts for which `kept_for` is true.
    """

    def __init__(
        self,
        quota_class: Callable[[str], QuotaClass],
        *,
        bounds: Bounds = AUDIT_BYTES.bounds,
        reserve: Bounds = AUDIT_RESERVE.bounds,
        kept_for: Callable[[str], bool] = lambda _host: False,
        clock: Callable[[], float] = clock.now,
    ) -> None:
        self.quota_class = quota_class
        self._plenty = bounds
        self._scarce = dataclasses.replace(bounds, host=reserve.host, unknown=reserve.host)
        self._kept, self._kept_for = reserve.kept, kept_for
        self._clock = clock
        self.owed: Pool[str] = Pool("bytes of audit records to pay off", bounds, quota_class)
        self._paid = clock()
        self._charged: dict[str, int] = {}  # bytes that `owed` does not have yet
        self._charged_bytes = 0
        self._changes: deque[tuple[str, int]] = deque()
        self._left: int | None = None

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

    def room(self, left: int | None) -> None:
        """Set how many bytes of the disk's reserve are left; None while more than the reserve is free."""
        self._left = left
        self.owed.bounds = self._plenty if left is None else self._scarce

    def shut_out(self, host: str) -> str:
        """Return why a nearly full disk blocks this host, or an empty string."""
        left = self._left
        if left is None or left >= self._kept or self._kept_for(host):
            return ""
        return (
            f"the disk of the audit log has {left} bytes left, which are kept for the robot and for hosts that the"
            " policy names"
        )

    def owing(self, host: str) -> str:
        """Return why calls of this host must wait, or an empty string."""
        if self._left is None and not self._changes and self._is_usual(host):
            return ""
        self._pay()
        return self.owed.refusal(host, 0)

    def pause(self, host: str) -> float:
        if not self.owing(host):
            return 0.0
        over = (self.owed.held(host) - self.owed.bounds.host) / self._pace
        return min(_LONGEST_PAUSE_SECONDS, max(_PAID_EVERY_SECONDS, over))

    def _is_usual(self, host: str) -> bool:
        if not (self.owed.held(host) or host in self._charged):
            return True
        owed = self.owed.total + self._charged_bytes
        return owed <= self._plenty.host and self._clock() - self._paid < _PAID_EVERY_SECONDS

    @property
    def _pace(self) -> int:
        return RATE if self._left is None else RATE // _SCARCE

    def _pay(self) -> None:
        charged, self._charged, self._charged_bytes = self._charged, {}, 0
        while self._changes:
            host, change = self._changes.popleft()
            charged[host] = charged.get(host, 0) + change
        for host, change in charged.items():
            if change > 0:
                self.owed.charge(host, change)
            else:
                self._lower(host, -change)
        now = self._clock()
        if now - self._paid >= _PAID_EVERY_SECONDS:
            paid, self._paid = int((now - self._paid) * self._pace), now
            for host, _owed in list(self.owed.holders()):
                self._lower(host, paid)

    def _lower(self, host: str, amount: int) -> None:
        self.owed.give_back(host, min(amount, self.owed.held(host)))
