"""The relay's listening sockets, one per incarnation, and the bounds on who may come in.

Invariants:
- There are never more than `connections` peers, nor more than `connections_per_host` of one host, nor more of
  strangers together than is theirs (`RELAY_CONNECTIONS` of the table of shares), in whatever stage. A peer within
  its share that finds no room is let in if `make_room` finds another that has to go.
- Accepting is a payer of its own in the loop: a flood of connections is accepted a quantum at a time, and each
  connection is charged to its host as well. When the process has no descriptor left, listening pauses instead of
  spinning.
"""

import errno
import socket
from collections.abc import Callable

from appliance.quotas.pool import Pool, Standing
from appliance.quotas.table import RELAY_CONNECTIONS
from appliance.relay.bounds import Limits
from appliance.relay.loop import ACCEPTING, QUANTUM, READ, Loop

_NO_DESCRIPTOR_PAUSE = 0.2
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class Ports:
    """Accepts peers: `arrived(key, sock, host)`, or `turned_away(key, host, reason)` without room.

    `standing(host)` is what the table knows of a host, `payer(host)` who pays for it. `make_room(host)` ends a
    connection for one of this host and says whether there was one.
    """

    def __init__(
        self,
        loop: Loop,
        limits: Limits,
        *,
        standing: Callable[[str], Standing],
        payer: Callable[[str], str],
        arrived: Callable[[str, socket.socket, str], None],
        turned_away: Callable[[str, str, str], None],
        make_room: Callable[[str], bool],
    ) -> None:
        self._loop = loop
        self._payer = payer
        self._arrived = arrived
        self._turned_away = turned_away
        self._listening: dict[str, socket.socket] = {}
        self._make_room = make_room
        bounds = RELAY_CONNECTIONS.bounds.sized(limits.connections, limits.connections_per_host)
        self.connected: Pool[str] = Pool("connections to the relay", bounds, standing)

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
        self.connected.give_back(host)

    def _watch(self, key: str, sock: socket.socket) -> None:
        self._loop.watch(sock.fileno(), READ, lambda _events: self._accept(key, sock), ACCEPTING)

    def _accept(self, key: str, listening: socket.socket) -> None:
        used = self._loop.used()
        while used < QUANTUM:
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
            payer = self._payer(host)
            reason = self._take(host)
            if reason:
                sock.close()
                self._turned_away(key, host, reason)
            else:
                self._arrived(key, sock, host)
            before, used = used, self._loop.used()
            self._loop.charge(payer, used - before)

    def _pause(self, key: str, listening: socket.socket) -> None:
        self._loop.unwatch(listening.fileno())

        def resume() -> None:
            if self._listening.get(key) is listening:
                self._watch(key, listening)

        self._loop.after(_NO_DESCRIPTOR_PAUSE, resume)

    def _take(self, host: str) -> str:
        """Count one more of this host; why not, when there is no room and nobody makes it."""
        pool = self.connected
        reason = pool.take(host)
        while reason and pool.held(host) < pool.bounds.host and self._make_room(host):
            reason = pool.take(host)
        return reason
