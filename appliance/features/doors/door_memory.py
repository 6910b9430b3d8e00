"""Divide the memory of one door among its clients and its node.

Messages that wait for other nodes count as one client, and so do the arguments of calls that wait for answers. Large
messages from other nodes have a memory of their own until they are complete, so slow clients cannot use it up.

1. Each client may always hold `least` bytes: half of the whole, divided by the maximum number of clients.
2. Beyond `least`, clients share the other half. A client gets no more of it than it leaves for all others, and all
   clients of a host get at most `HOST_SHARE` times that. A client is disconnected if it does not read the frames that
   take it (`session.py`).
"""

import sys
from collections import Counter
from collections.abc import Hashable, Iterator
from contextlib import contextmanager

from appliance.features.doors.quotas import DOOR_BYTES, DOOR_CONNECTIONS, HOST_SHARE
from roswire.errors import LimitExceededError

# Find the client that has begun a frame, or a message in several frames, and does not finish it.
#
# It grows by `_LEAST_SENT` bytes in `_SECONDS`, or is complete by then: by `_LEAST_SHARED` if the client holds memory
# that all clients share. Only seconds in which the door reads count, so a door that is busy blames no client. No I/O.

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


_REPLY_BYTES = 1 << 16  # that have room beside what is kept
_ENTRY_BYTES = 400  # of a table, with its objects


def kept_bytes(*texts: object) -> int:
    """Return about the bytes of an entry of a table that keeps these texts of a client."""
    return _ENTRY_BYTES + sum(map(sys.getsizeof, texts))


class DoorMemory:
    """The memory of one door with at most this many connections."""

    def __init__(self, connections: int = DOOR_CONNECTIONS.bounds.host) -> None:
        self.most_shared = DOOR_BYTES.bounds.whole // 2
        self.least = self.most_shared // (connections + 2)
        self.shared = 0
        self.shared_by: Counter[Hashable] = Counter()  # by host

    def client(self, host: Hashable = None) -> "ClientMemory":
        """Return the memory of a client; without a host, it is the only client of its host."""
        return ClientMemory(self, object() if host is None else host)


class ClientMemory:
    """One client's share of the memory; it holds `held` bytes."""

    def __init__(self, door: DoorMemory, host: Hashable) -> None:
        self.held = 0
        self.closed = False
        self.unfinished = Unfinished()
        self._door = door
        self.host = host
        self._shared = 0  # of the bytes that it holds, those of the shared half
        self._leaving = self._kept = 0

    def add(self, size: int) -> None:
        if self.closed:
            return
        self.held += size
        if self.held > self._door.least or self._shared:
            shared = max(0, self.held - self._door.least)
            self._door.shared += shared - self._shared
            self._door.shared_by[self.host] += shared - self._shared
            if not self._door.shared_by[self.host]:
                del self._door.shared_by[self.host]
            self._shared = shared

    def send(self, size: int) -> None:
        """Mark charged bytes as taken from the queue; `sent` releases them."""
        self._leaving += size

    def sent(self) -> None:
        if self._leaving:
            self.add(-self._leaving)
            self._leaving = 0

    @property
    def shares(self) -> bool:
        """Return whether this client holds memory of the shared half."""
        return self._shared > 0

    def refusal(self, size: int) -> str:
        held = self.held + size
        if held <= self._door.least:
            return ""
        shared, most = held - self._door.least, DOOR_BYTES.bounds.host
        left = self._door.most_shared - self._door.shared + self._shared - shared
        if held > most:
            return f"the client would hold {held} bytes; at most {most}"
        if shared > max(left, 0):
            return f"the client would hold {held} bytes of its door and leave {max(left, 0)} for all others"
        of_host = self._door.shared_by[self.host] + shared - self._shared
        if of_host > HOST_SHARE * left:
            return f"the clients of one host would hold {of_host} bytes of a door and leave {left} for all others"
        return ""

    def keep(self, size: int) -> None:
        """Charge bytes of what the client named, such as topics; a negative size gives them back."""
        self._kept += size
        self.add(size)

    def refusal_to_keep(self) -> str:
        """Return why nothing more is kept. Waiting frames take nothing of `least`: a stop may advertise its topic."""
        return self.refusal(_REPLY_BYTES) if self._kept > self._door.least else ""

    def try_take(self, size: int) -> bool:
        """Charge `size` bytes if this client may hold them; return whether it may."""
        held = self.held + size
        if held <= self._door.least and not self._shared and not self.closed:
            self.held = held
            return True
        if self.refusal(size):
            return False
        self.add(size)
        return True

    def take(self, size: int, trouble: str = "") -> None:
        if reason := self.refusal(size):
            raise LimitExceededError(trouble + reason)
        self.add(size)

    @contextmanager
    def holding(self, size: int) -> Iterator[None]:
        self.take(size)
        try:
            yield
        finally:
            self.add(-size)

    def close(self) -> None:
        self.add(-self.held)
        self.closed = True
