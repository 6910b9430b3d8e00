"""Find the client that has begun a frame, or a message in several frames, and does not finish it.

It grows by `_LEAST_SENT` bytes in `_SECONDS`, or is complete by then: by `_LEAST_SHARED` if the client holds memory
that all clients share. Only seconds in which the door reads count, so a door that is busy blames no client. No I/O.
"""

_SECONDS = 10.0
_EARLY = 0.001  # seconds by which a timer may ring too early
_LEAST_SENT = 1 << 14  # 13 kbit/s
_LEAST_SHARED = 1 << 18  # 210 kbit/s


class Unfinished:
    """The unfinished frame of one client; `left` is the time until it is checked."""

    def __init__(self) -> None:
        self.left = _SECONDS
        self._size: int | None = None
        self._checked = 0  # its size at the last check

    def grew(self, size: int) -> None:
        """Note that the frame, which may be new, has `size` bytes now."""
        if self._size is None:
            self.left, self._checked = _SECONDS, 0
        self._size = size

    def finished(self) -> None:
        self._size = None

    def waited(self, seconds: float, *, shares: bool) -> str:
        """Return why the client must be disconnected, or an empty text."""
        self.left -= seconds
        if self.left > _EARLY:
            return ""
        self.left = _SECONDS
        if self._size is None:
            return ""
        sent, self._checked = self._size - self._checked, self._size
        least = _LEAST_SHARED if shares else _LEAST_SENT
        if sent >= least:
            return ""
        return f"the client sent {sent} bytes in {_SECONDS:g} s of what it has begun; at least {least}"
