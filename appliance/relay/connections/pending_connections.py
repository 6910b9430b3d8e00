"""Connections that are not served yet: the memory for their headers, and the order in which they are ended.

- The first `_FREE` bytes of a header are not counted, so a flood of long headers does not keep out normal ones.
- Connections of hosts without a grant are ended first, the longest wait first. A connection of another host is ended
  only after `_PATIENCE` seconds.
"""

from collections.abc import Callable
from typing import Protocol

from appliance.quotas.pool import Queue, QuotaClass
from appliance.relay.transport.memory import HeldBytes, MemoryPool

_FREE = 4096
_PATIENCE = 1.0


class PendingConnection(Protocol):
    """A connection that is not served yet, or a refused one."""

    def make_room(self) -> None:
        """End now, and `leave`."""


class PendingConnections:
    """The connections that are not served yet."""

    def __init__(
        self, clock: Callable[[], float], quota_class: Callable[[str], QuotaClass], headers: MemoryPool
    ) -> None:
        self._clock = clock
        self._quota_class = quota_class
        self._held: dict[PendingConnection, HeldBytes] = {}
        self._headers = headers
        self._waiting: Queue[str, PendingConnection] = Queue(quota_class)
        self._with_long_headers: Queue[str, PendingConnection] = Queue(quota_class)

    def enter(self, guest: PendingConnection, host: str) -> None:
        self._held[guest] = HeldBytes(self._headers.of(host))
        self._waiting.put(guest, host, self._clock())

    def leave(self, guest: PendingConnection) -> None:
        self._waiting.remove(guest)
        self._with_long_headers.remove(guest)
        held = self._held.pop(guest, None)
        if held is not None:
            held.set(0)

    def hold(self, guest: PendingConnection, size: int) -> str:
        held = self._held[guest]
        share, more = held.share, max(0, size - _FREE) - held.size
        if more <= 0:
            return ""
        why = share.refusal(more)
        while (
            why
            and share.used + more <= self._headers.bounds.host
            and self._end_longest(self._with_long_headers, share.host, but=guest)
        ):
            why = share.refusal(more)
        if not why:
            if not held.size:
                self._with_long_headers.put(guest, share.host, self._clock())
            held.set(held.size + more)
        return why

    def make_room(self, host: str) -> bool:
        return self._end_longest(self._waiting, host)

    def _end_longest(
        self, queue: Queue[str, PendingConnection], host: str, *, but: PendingConnection | None = None
    ) -> bool:
        mine = self._quota_class(host)
        for quota_class in QuotaClass:
            found = queue.longest(quota_class) if quota_class <= mine else None
            if found is None or found[0] is but:
                continue
            young = self._clock() - found[2] < _PATIENCE
            if quota_class is QuotaClass.REGISTERED and young:
                continue
            found[0].make_room()
            return True
        return False
