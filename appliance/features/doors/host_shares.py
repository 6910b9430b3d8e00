"""Divide what one door has in pieces, such as connections, among the hosts of its clients (`Bounds.share`). No I/O."""

from collections.abc import Collection, Hashable, Sequence
from typing import Protocol

from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.quotas import HOST_SHARE
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from roswire.errors import LimitExceededError


class _Client(Protocol):
    @property
    def memory(self) -> ClientMemory: ...


def of_hosts(what: str, whole: int) -> Pool[Hashable]:
    bounds = Bounds(whole, whole, unknown=0, kept=0, share=HOST_SHARE)
    return Pool(what, bounds, lambda _host: QuotaClass.REGISTERED)


def check_share(what: str, bounds: Bounds, used: Sequence[Collection[_Client]], client: _Client) -> None:
    """Raise `LimitExceededError` if `client` may not use a further piece; `used` has the clients of each.

    Unlike a holding in a pool, a piece may have clients of several hosts.
    """
    total, host, what = len(used) + 1, client.memory.host, f"{what} of this door"
    if total > bounds.whole:
        raise LimitExceededError(f"all clients together use {len(used)} {what}; the limit is {bounds.whole}")
    if bounds.share_refusal(host, total, total, what):  # otherwise, no host can have too many
        own = 1 + sum(any(one.memory.host == host for one in clients) for clients in used)
        if reason := bounds.share_refusal(host, own, total, what):
            raise LimitExceededError(reason)
