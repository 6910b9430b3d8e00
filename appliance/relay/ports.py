"""The relay's listening sockets, one per incarnation, and the bounds on who may come in.

Invariants:
- There are never more than `connections` peers, nor more than `connections_per_host` of one host, in whatever
  stage.
- A flood of connections is accepted in slices, so that relayed messages go on between them; when the process
  has no descriptor left, listening pauses instead of spinning.
"""

import errno
import socket
from collections import Counter
from collections.abc import Callable

from appliance.relay.limits import Limits
from appliance.relay.loop import READ, Loop

_ACCEPTS_PER_TURN = 32
_NO_DESCRIPTOR_PAUSE = 0.2
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class Ports:
    """Accepts peers: `arrived(key, sock, host)`, or `turned_away(key, host, reason)` without room."""

    def __init__(
        self,
        loop: Loop,
        limits: Limits,
        arrived: Callable[[str, socket.socket, str], None],
        turned_away: Callable[[str, str, str], None],
    ) -> None:
        self._loop = loop
        self._limits = limits
        self._arrived = arrived
        self._turned_away = turned_away
        self._listening: dict[str, socket.socket] = {}
        self._hosts: Counter[str] = Counter()
        self._total = 0

    def open(self, key: str, descriptor: int) -> None:
        """Listen on this socket for the incarnation; an earlier socket of it is closed after the new one
        listens."""
        sock = socket.socket(fileno=descriptor)
        sock.setblocking(False)
        before = self._listening.get(key)
        self._listening[key] = sock
        self._watch(key, sock)
        if before is not None:
            self._loop.discard(before)

    def close(self, key: str) -> None:
        """Listen for the incarnation no more."""
        sock = self._listening.pop(key, None)
        if sock is not None:
            self._loop.discard(sock)

    def close_all(self) -> None:
        """Listen no more."""
        for key in list(self._listening):
            self.close(key)

    def left(self, host: str) -> None:
        """A peer that arrived is gone."""
        self._total -= 1
        self._hosts[host] -= 1
        if not self._hosts[host]:
            del self._hosts[host]

    def _watch(self, key: str, sock: socket.socket) -> None:
        self._loop.watch(sock.fileno(), READ, lambda _events: self._accept(key, sock))

    def _accept(self, key: str, listening: socket.socket) -> None:
        for _ in range(_ACCEPTS_PER_TURN):
            try:
                sock, address = listening.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _EXHAUSTED:
                    self._pause(key, listening)
                    return
                continue  # this peer is gone already; the next may be well
            host = address[0].removeprefix("::ffff:")
            reason = self._no_room(host)
            if reason:
                sock.close()
                self._turned_away(key, host, reason)
            else:
                self._total += 1
                self._hosts[host] += 1
                self._arrived(key, sock, host)

    def _pause(self, key: str, listening: socket.socket) -> None:
        self._loop.unwatch(listening.fileno())

        def resume() -> None:
            if self._listening.get(key) is listening:
                self._watch(key, listening)

        self._loop.after(_NO_DESCRIPTOR_PAUSE, resume)

    def _no_room(self, host: str) -> str:
        if self._total >= self._limits.connections:
            return f"the relay has {self._total} connections, which is its limit"
        if self._hosts[host] >= self._limits.connections_per_host:
            return f"{host} has {self._hosts[host]} connections to the relay, which is the limit for one host"
        return ""
