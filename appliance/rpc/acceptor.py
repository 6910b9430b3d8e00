"""Accept the connections of a listening socket, several in one turn of the event loop.

The kernel queues connections in order of arrival, and the acceptor empties this queue quickly. `accepted` then decides
by host whether a connection may wait. So a host that connects without end does not fill the queues of other hosts.

A queue with `paced` is for hosts that no policy rule names: accepting from it waits for the turn of unknown hosts.
"""

import asyncio
import errno
import socket
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.policy.model import Address, address_of
from appliance.rpc.front import plain_address
from appliance.rpc.processor_time import ProcessorTime

BACKLOG = 4096
_CLOSING_SECONDS = 15e-6  # the processor time to accept and close a connection
_AT_ONCE = 256  # the most connections in one turn of the event loop
_AT_ONCE_PACED = 32  # the most connections in one paced turn
_UNKNOWN = address_of("0.0.0.0")  # noqa: S104 - stands for all unknown hosts, which are charged as one host
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # the pause after the process ran out of descriptors

_log = structlog.get_logger()


class Acceptor:
    """`accepted` owns the socket; the host is charged for the time.

    If it returns False (too many connections), other connections of this host in the same turn are closed at once.
    With `paced`, accepting waits for the turn of unknown hosts.
    """

    def __init__(
        self,
        sock: socket.socket,
        time: ProcessorTime,
        accepted: Callable[[socket.socket, Address], bool],
        *,
        paced: bool = False,
    ) -> None:
        self._sock = sock
        self._time = time
        self._accepted = accepted
        self._at_once = _AT_ONCE_PACED if paced else _AT_ONCE
        self._pause: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._readable = self._accept_in_turn if paced else self._accept
        sock.setblocking(False)
        sock.listen(BACKLOG)
        self._loop.add_reader(sock, self._readable)

    def close(self) -> None:
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def _accept_in_turn(self) -> None:
        if not self._time.run(_UNKNOWN, self._accept_paced):
            self._loop.remove_reader(self._sock)

    def _accept_paced(self) -> None:
        if self._sock.fileno() >= 0:  # False if the socket was closed before its turn
            self._loop.add_reader(self._sock, self._readable)
            self._accept()

    def _accept(self) -> None:
        closed: Counter[str] = Counter()
        try:
            for _ in range(self._at_once):
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
        outermost = self._time.begin()
        try:
            return self._accepted(sock, host)
        finally:
            if outermost:
                self._time.end(host)

    def _wait(self, error: OSError) -> None:
        _log.error("no connection can be accepted", reason=str(error))
        self._loop.remove_reader(self._sock)
        self._pause = self._loop.call_later(_PAUSE_SECONDS, self._loop.add_reader, self._sock, self._readable)
