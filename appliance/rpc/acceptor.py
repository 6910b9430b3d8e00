"""Accept the connections of a listening socket, several in a turn of the event loop.

The kernel has one queue for all hosts, in order of arrival. The acceptor empties it quickly. Later code decides by host
whether a connection may wait and when it is opened, so a host that connects without end fills no shared queue.
"""

import asyncio
import errno
import socket
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.policy.model import Address
from appliance.rpc.front import plain_address
from appliance.rpc.processor_time import ProcessorTime

BACKLOG = 4096
_CLOSING_SECONDS = 15e-6  # of processor time, to accept and close a connection
_AT_ONCE = 256  # connections in one turn of the loop
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # after the process ran out of descriptors

_log = structlog.get_logger()


class Acceptor:
    """Pass each connection and its host to `accepted`, which then owns the socket; charge the time to the host.

    If `accepted` returns False (too many), further connections of that host in the same turn are closed at once.
    """

    def __init__(
        self, sock: socket.socket, time: ProcessorTime, accepted: Callable[[socket.socket, Address], bool]
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
        """Stop accepting, and close the listening socket."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def _accept(self) -> None:
        closed: Counter[str] = Counter()
        try:
            for _ in range(_AT_ONCE):
                sock, address = self._sock.accept()
                text = address[0]
                if text in closed:
                    sock.close()
                    closed[text] += 1
                elif not self._hand_over(sock, text):
                    closed[text] = 0
        except BlockingIOError:
            pass
        except OSError as error:
            if error.errno not in _GONE:
                self._wait(error)
        for text, count in closed.items():
            self._time.charge(plain_address(text), count * _CLOSING_SECONDS)

    def _hand_over(self, sock: socket.socket, text: str) -> bool:
        host = plain_address(text)
        self._time.begin()
        try:
            return self._accepted(sock, host)
        finally:
            self._time.end(host)

    def _wait(self, error: OSError) -> None:
        """Pause accepting for a while."""
        _log.error("no connection can be accepted", reason=str(error))
        self._loop.remove_reader(self._sock)
        self._pause = self._loop.call_later(_PAUSE_SECONDS, self._loop.add_reader, self._sock, self._accept)
