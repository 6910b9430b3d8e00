"""Accept the connections of a listening socket, several in a turn of the event loop.

The kernel's queue is in order of arrival. The acceptor empties it quickly. Later code decides by host whether a
connection may wait and when it is opened, so a host that connects without end fills no queue of other hosts.

The queue of hosts that no rule names is paced: accepting from it waits for the turn of unknown hosts.
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
_CLOSING_SECONDS = 15e-6  # of processor time, to accept and close a connection
_AT_ONCE = 256  # connections in one turn of the loop
_AT_ONCE_PACED = 32  # in one piece of work
_UNKNOWN = address_of("0.0.0.0")  # noqa: S104 - for all unknown hosts, which share processor time as one
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE_SECONDS = 0.2  # after the process ran out of descriptors

_log = structlog.get_logger()


class Acceptor:
    """The acceptor: passes each connection and its host to `accepted`, which owns the socket; charges the host.

    If `accepted` returns False (too many), further connections of that host in the same turn are closed at once.
    With `paced`, accepting is work of the unknown hosts, and waits for their turn.
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
        """Stop accepting, and close the listening socket."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def _accept_in_turn(self) -> None:
        if not self._time.run(_UNKNOWN, self._accept_paced):
            self._loop.remove_reader(self._sock)

    def _accept_paced(self) -> None:
        if self._sock.fileno() >= 0:  # else it was closed before its turn
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
        """Pause accepting for a while."""
        _log.error("no connection can be accepted", reason=str(error))
        self._loop.remove_reader(self._sock)
        self._pause = self._loop.call_later(_PAUSE_SECONDS, self._loop.add_reader, self._sock, self._readable)
