"""The relay's listening sockets, one for each incarnation, and the limits on connections.

- All unknown hosts share one quota (`RELAY_CONNECTIONS`). If all connections are in use, a peer within its quota is
  accepted if `make_room` ends another connection.
- A flood of connections is accepted one quantum at a time, and charged to its hosts. When the process has no
  descriptor left, listening pauses.
"""

import errno
import socket
from collections.abc import Callable

from appliance.quotas.pool import Pool
from appliance.quotas.table import RELAY_CONNECTIONS
from appliance.relay.context import RelayContext
from appliance.relay.loop import ACCEPTING, QUANTUM, READ
from appliance.relay.transport.sockets import tune

_NO_DESCRIPTOR_PAUSE = 0.2
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class ListeningPorts:
    """Accepts peers: calls `arrived(key, sock, host)`, or `turned_away(key, host, reason)` when a limit is reached."""

    def __init__(
        self,
        context: RelayContext,
        *,
        arrived: Callable[[str, socket.socket, str], None],
        turned_away: Callable[[str, str, str], None],
        make_room: Callable[[str], bool],
    ) -> None:
        self._loop = context.loop
        self._payer = context.payer
        self._arrived = arrived
        self._turned_away = turned_away
        self._listening: dict[str, socket.socket] = {}
        self._make_room = make_room
        limits, quota_class = context.limits, context.table.quota_class
        bounds = RELAY_CONNECTIONS.bounds.resize(limits.connections, limits.connections_per_host)
        self.connected: Pool[str] = Pool("connections to the relay", bounds, quota_class)

    def open(self, key: str, descriptor: int) -> None:
        sock = socket.socket(fileno=descriptor)
        sock.setblocking(False)
        before = self._listening.get(key)
        self._listening[key] = sock
        self._watch(key, sock)
        if before is not None:
            self._loop.discard(before)

    def close(self, key: str) -> None:
        sock = self._listening.pop(key, None)
        if sock is not None:
            self._loop.discard(sock)

    def close_all(self) -> None:
        for key in list(self._listening):
            self.close(key)

    def left(self, host: str) -> None:
        self.connected.give_back(host)

    def _watch(self, key: str, sock: socket.socket) -> None:
        self._loop.watch(sock.fileno(), READ, lambda _events: self._accept(key, sock), ACCEPTING)

    def _accept(self, key: str, listening: socket.socket) -> None:
        used = self._loop.time_used()
        while used < QUANTUM:
            try:
                sock, address = listening.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _EXHAUSTED:
                    self._pause(key, listening)
                    return
                used = self._loop.time_used()
                continue  # this peer has left already; the next may be connected
            host = address[0].removeprefix("::ffff:")
            payer = self._payer(host)
            self._receive(key, sock, host)
            before, used = used, self._loop.time_used()
            self._loop.charge(payer, used - before)

    def _receive(self, key: str, sock: socket.socket, host: str) -> None:
        try:
            tune(sock)
        except OSError:  # this peer has left already
            sock.close()
            return
        reason = self._take(host)
        if reason:
            sock.close()
            self._turned_away(key, host, reason)
        else:
            self._arrived(key, sock, host)

    def _pause(self, key: str, listening: socket.socket) -> None:
        self._loop.unwatch(listening.fileno())

        def resume() -> None:
            if self._listening.get(key) is listening:
                self._watch(key, listening)

        self._loop.after(_NO_DESCRIPTOR_PAUSE, resume)

    def _take(self, host: str) -> str:
        pool = self.connected
        reason = pool.take(host)
        while reason and pool.held(host) < pool.bounds.host and self._make_room(host):
            reason = pool.take(host)
        return reason
