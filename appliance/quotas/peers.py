"""Tell peers apart, and divide a report among them. No I/O.

An IPv6 peer counts by its /64 network, because one host can use all addresses of that network.
"""

import ipaddress
from collections import Counter

_V6_PREFIX = 64


def peer_key(host: str) -> str:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if address.version == 4 or address.is_loopback:
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, _V6_PREFIX), strict=False))


class ReportShares:
    """Divides the rows of a report among peers; the owner calls `clear` after the report.

    A peer has one row at least, and at most three quarters of `most`. Further ones are counted in one row of the peer.
    Only peers beyond `most` share such a row.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._rows: Counter[str] = Counter()  # by peer
        self._first: dict[str, str] = {}  # a peer's first address

    def rest_of(self, host: str) -> str | None:
        """Return None if a new row of `host` has room; otherwise the address to count it for, or "" for many peers."""
        peer = peer_key(host)
        if peer not in self._rows:
            if len(self._rows) >= self._most:
                return ""
            self._first[peer] = host
        elif self._rows.total() >= self._most or self._rows[peer] >= self._most - self._most // 4:
            return self._first[peer]
        self._rows[peer] += 1
        return None

    def clear(self) -> None:
        self._rows.clear()
        self._first.clear()
