"""Divide what one door has in pieces, such as connections, among the hosts of its clients. No I/O.

A host gets one, and further ones up to `HOST_SHARE` times what it leaves for all others.
"""

from collections import Counter
from collections.abc import Hashable

from appliance.features.doors.quotas import HOST_SHARE


def exceeds_share(own: int, left: int) -> bool:
    """Whether a host with `own` pieces may not have a further one, which leaves `left` for all others."""
    return left < 0 or (own > 0 and own + 1 > HOST_SHARE * left)


class HostShares:
    """The pieces that each host has; in refusals, `what` is their name."""

    def __init__(self, what: str, most: int) -> None:
        self._what = what
        self._most = most
        self._held: Counter[Hashable] = Counter()

    def refusal(self, host: Hashable) -> str:
        total, own = self._held.total(), self._held[host]
        left = self._most - total - 1
        if not exceeds_share(own, left):
            return ""
        if left < 0:
            return f"this door has {total} {self._what}; at most {self._most} are allowed"
        return f"one host has {own} {self._what} of this door; the others are kept for other hosts"

    def take(self, host: Hashable) -> None:
        self._held[host] += 1

    def give_back(self, host: Hashable) -> None:
        self._held[host] -= 1
        if not self._held[host]:
            del self._held[host]
