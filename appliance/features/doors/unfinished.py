"""Find the client that has begun something and does not finish it: a frame, a fragmented message, or `fragment`s.

Each of these grows by `_LEAST_SENT` bytes in `_SECONDS`, or is complete by then: by `_LEAST_SHARED` if the client
holds memory that all clients share. Only seconds in which the door reads count, so a door that is busy blames no
client. No I/O.
"""

from collections.abc import Hashable

_SECONDS = 10.0
_EARLY = 0.001  # seconds by which a timer may ring too early
_LEAST_SENT = 1 << 14  # 13 kbit/s
_LEAST_SHARED = 1 << 18  # 210 kbit/s


class Unfinished:
    """The unfinished things of one client; `left` is the time until they are checked."""

    def __init__(self) -> None:
        self.left = _SECONDS
        self._sizes: dict[Hashable, int] = {}
        self._checked: dict[Hashable, int] = {}  # their sizes at the last check

    def grew(self, key: Hashable, size: int) -> None:
        """Note that `key`, which may be new, has `size` bytes now."""
        if not self._sizes:
            self.left, self._checked = _SECONDS, {key: 0}
        self._sizes[key] = size

    def finished(self, key: Hashable) -> None:
        self._sizes.pop(key, None)
        self._checked.pop(key, None)

    def waited(self, seconds: float, *, shares: bool) -> str:
        """Return why the client must be disconnected, or an empty text."""
        self.left -= seconds
        if self.left > _EARLY:
            return ""
        least = _LEAST_SHARED if shares else _LEAST_SENT
        slowest = min((self._sizes[key] - size for key, size in self._checked.items()), default=least)
        self.left, self._checked = _SECONDS, self._sizes.copy()
        if slowest >= least:
            return ""
        return f"the client sent {slowest} bytes in {_SECONDS:g} s of what it has begun; at least {least}"
