"""Peers that have come and are not served: what their headers hold, and which of them makes room.

Invariants:
- The first `_FREE` bytes of a header are counted by nobody, so that no flood of long ones keeps out a header as ROS
  nodes send it; what is beyond counts in the memory of its host.
- The peer that waits longest goes first, and a host without a grant before one with a grant. Of hosts with a grant
  only what has waited for `_PATIENCE` seconds goes for another of them.
"""

from collections.abc import Callable
from typing import Protocol

from appliance.quotas.pool import Standing
from appliance.quotas.queue import Queue
from appliance.relay.connections.memory import HostShares

_FREE = 4096
_PATIENCE = 1.0


class Guest(Protocol):
    """A peer that waits."""

    def make_room(self) -> None:
        """End now, and `leave`."""


class Anteroom:
    """The peers that wait.

    `standing(host)` says whether a host has a grant; `clock` is monotonic seconds; `headers` is what hosts hold of the
    memory for headers.
    """

    def __init__(
        self, clock: Callable[[], float], standing: Callable[[str], Standing], headers: HostShares
    ) -> None:
        self._clock = clock
        self._standing = standing
        self._hosts: dict[Guest, str] = {}
        self._long: dict[Guest, int] = {}
        self._headers = headers
        self._waiting: Queue[str, Guest] = Queue(standing)
        self._with_long_headers: Queue[str, Guest] = Queue(standing)

    def enter(self, guest: Guest, host: str) -> None:
        """This peer waits from now on."""
        self._hosts[guest] = host
        self._waiting.put(guest, host, self._clock())

    def leave(self, guest: Guest) -> None:
        """End the peer's waiting, if it waits."""
        self._waiting.remove(guest)
        self._with_long_headers.remove(guest)
        host, held = self._hosts.pop(guest, None), self._long.pop(guest, 0)
        if host is not None and held:
            self._headers.of(host).add(-held)

    def hold(self, guest: Guest, size: int) -> str:
        """Count the bytes that its header has by now; the reason if that is too much."""
        host, before = self._hosts[guest], self._long.get(guest, 0)
        more = max(0, size - _FREE) - before
        if more <= 0:
            return ""
        share = self._headers.of(host)
        why = share.refusal(more)
        while (
            why
            and share.used + more <= self._headers.bounds.host
            and self._end_longest(self._with_long_headers, host, but=guest)
        ):
            why = share.refusal(more)
        if not why:
            share.add(more)
            if not before:
                self._with_long_headers.put(guest, host, self._clock())
            self._long[guest] = before + more
        return why

    def make_room(self, host: str) -> bool:
        """End the connection of a peer whose place this host may have; whether there was one."""
        return self._end_longest(self._waiting, host)

    def _end_longest(self, queue: Queue[str, Guest], host: str, *, but: Guest | None = None) -> bool:
        mine = self._standing(host)
        for standing in Standing:
            found = queue.longest(standing) if standing <= mine else None
            if found is None or found[0] is but:
                continue
            young = self._clock() - found[2] < _PATIENCE
            if standing is Standing.REGISTERED and young:
                continue
            found[0].make_room()
            return True
        return False
