"""Divide what one door has in pieces, such as connections, among the hosts of its clients. No I/O.

A host gets one, and further ones up to `HOST_SHARE` times what it leaves for all others.
"""

from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from typing import Protocol

from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.quotas import HOST_SHARE
from roswire.errors import LimitExceededError


class _Client(Protocol):
    @property
    def memory(self) -> ClientMemory: ...


def exceeds_share(own: int, left: int) -> bool:
    """Whether a host with `own` pieces may not have a further one, which leaves `left` for all others."""
    return left < 0 or (own > 0 and own + 1 > HOST_SHARE * left)


def check_share(what: str, most: int, used: Sequence[Collection[_Client]], client: _Client) -> None:
    """Raise `LimitExceededError` if `client` may not use a further piece; `used` has the clients of each."""
    left, host = most - len(used) - 1, client.memory.host
    if left < 0:
        raise LimitExceededError(f"the clients of this door use {len(used)} {what}; at most {most}")
    if exceeds_share(len(used), left):  # otherwise, no host can have too many
        own = sum(any(one.memory.host == host for one in clients) for clients in used)
        if exceeds_share(own, left):
            raise LimitExceededError(
                f"one host uses {own} {what} of this door; the others are kept for other hosts"
            )


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
