"""How many bytes of records each host may cause, over time; and how few while the disk is nearly full. No I/O.

What a host's calls leave in the log is charged to that host, and time pays it off (`RATE`). A host that owes more than
its share (`AUDIT_BYTES`) waits until it owes less: its calls, nobody else's. While only the reserve of the disk is left
(`AUDIT_RESERVE`), shares and rates are a fraction of that, and the last of it is for hosts with a registration.

Strangers owe nothing and wait for nothing: they are served nothing, and what is recorded of that is folded.

Used on one thread, except for `folded`, `summarised` and `room`, which any thread may call.
"""

import dataclasses
import time
from collections import deque
from collections.abc import Callable

from appliance.audit.record import Record
from appliance.quotas.pool import Bounds, Pool, Standing
from appliance.quotas.table import AUDIT_BYTES, AUDIT_RESERVE

RATE = 64 << 10
"""Bytes a second that a host pays off; on a disk that is nearly full a `_SCARCE` part of it."""

_SCARCE = 8
_RECORD_BYTES = 400  # on disk, with its entries in the indices
_BYTES_PER_CHARACTER = 2  # the text, and what of it is in the full-text index
_PAID_EVERY_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 1.0


def weight(record: Record) -> int:
    """About how many bytes a record takes on disk."""
    size = len(record.caller_id or "") + len(record.resource or "") + len(record.reason)
    for value in record.detail.values():
        size += len(value if type(value) is str else str(value))
    return _RECORD_BYTES + _BYTES_PER_CHARACTER * size


class Budget:
    """What hosts owe; `standing` says what is known of a host, `clock` gives seconds and is never set back.

    `reserve` are the shares while only so much of the disk is left.
    """

    def __init__(
        self,
        standing: Callable[[str], Standing],
        *,
        bounds: Bounds = AUDIT_BYTES.bounds,
        reserve: Bounds = AUDIT_RESERVE.bounds,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.standing = standing
        self._plenty, self._scarce = bounds, dataclasses.replace(bounds, host=reserve.host)
        self._kept = reserve.kept
        self._clock = clock
        self.owed: Pool[str] = Pool("bytes of audit records to pay off", bounds, standing)
        self._paid = clock()
        self._changes: deque[tuple[str, int]] = deque()
        self._left: int | None = None

    def charge(self, record: Record) -> None:
        """A record was made about its host; when it is only counted, it is taken off again."""
        if record.host is not None and not record.stranger:
            self.owed.charge(record.host, weight(record))

    def folded(self, record: Record) -> None:
        """A record was counted only, not written."""
        if record.host is not None and not record.stranger:
            self._changes.append((record.host, -weight(record)))

    def summarised(self, record: Record) -> None:
        """A summary of what was counted is written."""
        if record.host is not None and not record.stranger:
            self._changes.append((record.host, weight(record)))

    def room(self, left: int | None) -> None:
        """So many bytes of the disk's reserve are left; None while there are more than that."""
        self._left = left

    def shut_out(self, host: str) -> str:
        """Why nothing is granted to this host while so little of the disk is left, in words for it; else empty."""
        left = self._left
        if left is None or left >= self._kept or self.standing(host) is Standing.REGISTERED:
            return ""
        return (
            f"the disk of the audit log has {left} bytes left, which are kept for hosts with a registration"
        )

    def owing(self, host: str) -> str:
        """Why calls of this host have to wait, in words for it; empty when they need not."""
        if self._left is None and not self._changes and self._is_usual(host):
            return ""
        self._pay()
        self.owed.bounds = self._plenty if self._left is None else self._scarce
        return self.owed.refusal(host, 0)

    def pause(self, host: str) -> float:
        """For how many seconds this host's calls wait, then to be asked again; 0 when they need not."""
        if not self.owing(host):
            return 0.0
        over = (self.owed.held(host) - self.owed.bounds.host) / self._pace
        return min(_LONGEST_PAUSE_SECONDS, max(_PAID_EVERY_SECONDS, over))

    def _is_usual(self, host: str) -> bool:
        """Whether a look at what all owe together shows that this host need not wait, and nothing is to be paid yet."""
        if not self.owed.held(host):
            return True
        return self.owed.total <= self._plenty.host and self._clock() - self._paid < _PAID_EVERY_SECONDS

    @property
    def _pace(self) -> int:
        return RATE if self._left is None else RATE // _SCARCE

    def _pay(self) -> None:
        """Take off what was only counted, and what time has paid; add the summaries."""
        while self._changes:
            host, change = self._changes.popleft()
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
