"""Accepts the connections of a listening socket, several in a turn of the loop.

The kernel's queue is one for all hosts, first come, first served. It is emptied quickly and cheaply: whether a
connection may wait, and when it is opened, is decided behind it, by host. So a host that connects without end fills
no queue that others need.
"""

import asyncio
import errno
import socket
from collections.abc import Callable

import structlog

from appliance.policy.model import Address
from appliance.rpc.front import plain_address
from appliance.rpc.processor_time import ProcessorTime

BACKLOG = 4096
_AT_ONCE = 512  # connections in one turn of the loop
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # when the process has no descriptor left

_log = structlog.get_logger()


class Acceptor:
    """Hands each connection, and its host, to `accepted`, which owns the socket then; the time is the host's."""

    def __init__(
        self, sock: socket.socket, time: ProcessorTime, accepted: Callable[[socket.socket, Address], None]
    ) -> None:
        self._sock = sock
        self._time = time
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
            host = None
            self._time.begin()
            try:
                sock, address = self._sock.accept()
                sock.setblocking(False)
                host = plain_address(address[0])
                self._accepted(sock, host)
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
            finally:
                self._time.end(host)
