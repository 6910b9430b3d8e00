"""Accepts the connections of a listening socket, several in a turn of the loop.

The kernel's queue is one for all hosts. It is emptied quickly, and cheaply: whether a connection has a place, and when
it is its turn, is decided behind it, by host. So a host that connects without end fills no queue that others need.
"""

import asyncio
import errno
import socket
from collections.abc import Callable

import structlog

BACKLOG = 4096
_AT_ONCE = 64  # connections in one turn of the loop
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # when the process has no descriptor left

_log = structlog.get_logger()


class Acceptor:
    """Hands each connection, and the peer's address, to `accepted`, which owns the socket then."""

    def __init__(self, sock: socket.socket, accepted: Callable[[socket.socket, str], None]) -> None:
        self._sock = sock
        self._accepted = accepted
        self._pause: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        sock.setblocking(False)
        sock.listen(BACKLOG)
        self._loop.add_reader(sock, self._accept)

    def close(self) -> None:
        """Accept no more; the listening socket is closed."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def _accept(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                sock, address = self._sock.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _GONE:
                    continue
                _log.error("no connection can be accepted", reason=str(error))
                self._loop.remove_reader(self._sock)
                self._pause = self._loop.call_later(
                    _PAUSE_SECONDS, self._loop.add_reader, self._sock, self._accept
                )
                return
            sock.setblocking(False)
            self._accepted(sock, address[0])
