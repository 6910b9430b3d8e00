"""Limit the rate of each peer with token buckets. No I/O; the time is a parameter.

A new bucket replaces the least recently used one, so a flood from many addresses gains at most one burst for each.
"""

from collections import OrderedDict

from appliance.quotas.peers import peer_key


class Buckets:
    """Token buckets that permit `burst` requests at once and `per_second` on average."""

    def __init__(self, per_second: float, burst: float, *, peers: int = 4096) -> None:
        self._per_second = per_second
        self._burst = burst
        self._peers = peers
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, host: str, now: float) -> float:
        left = self._tokens_left(host, now)
        if left < 1:
            self._keep(host, left, now)
            return (1 - left) / self._per_second
        self._keep(host, left - 1, now)
        return 0.0

    def give_back(self, host: str, now: float) -> None:
        self._keep(host, min(self._burst, self._tokens_left(host, now) + 1), now)

    def wait(self, host: str, now: float) -> float:
        """Return the seconds until `take` succeeds, without taking a token."""
        left = self._tokens_left(host, now)
        return 0.0 if left >= 1 else (1 - left) / self._per_second

    def is_touched(self, host: str, now: float) -> bool:
        return self._tokens_left(host, now) < self._burst

    def _tokens_left(self, host: str, now: float) -> float:
        left, then = self._buckets.get(peer_key(host), (self._burst, now))
        return min(self._burst, left + max(0.0, now - then) * self._per_second)

    def _keep(self, host: str, left: float, now: float) -> None:
        key = peer_key(host)
        self._buckets[key] = (left, now)
        self._buckets.move_to_end(key)
        if len(self._buckets) > self._peers:
            self._buckets.popitem(last=False)
