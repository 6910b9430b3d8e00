"""Set the options of the relay's sockets, and buffer writes without blocking."""

import contextlib
import errno
import socket
from collections.abc import Callable

from appliance.relay.loop import HANGUP, READ, WRITE, EventLoop

# Not every process may choose cubic, but every kernel allows reno to unprivileged processes. With bbr, the default of
# some systems, large messages over loopback and a bridge are about half as fast as with cubic or reno.
_CONGESTION = (b"cubic", b"reno")
# A firewall that shuts out the appliance for a moment resets only the peer's end of a connection. A publisher's end is
# then noticed by the next probe, soon after an interruption that lost earlier ones. Unanswered probes end a connection
# after more than two minutes.
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, 67))
_READ_SIZE = 64 << 10


def tune(sock: socket.socket) -> None:
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)
    for name in _CONGESTION:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, name)
            return


def congestion_control() -> str:
    with socket.socket() as sock:
        tune(sock)
        return sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0").decode()


def begin_connect(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.inet_pton(family, host)
    except (OSError, ValueError):
        raise OSError(errno.EINVAL, f"{host!r} is not an IP address") from None
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        tune(sock)
        error = sock.connect_ex((host, port))
        if error not in {0, errno.EINPROGRESS}:
            raise OSError(error, f"cannot connect to {host}:{port}: {errno.errorcode.get(error, error)}")
    except BaseException:
        sock.close()
        raise
    return sock


class BufferedSocket:
    """A connected (or connecting) socket with a write buffer, for everything except the fast path.

    `received(data)` gets b"" once at the end of the connection, `drained()` is called whenever the last waiting byte
    has left, and `broken(reason)` once. After `close` or `take`, no callback is called.
    """

    def __init__(
        self,
        loop: EventLoop,
        sock: socket.socket,
        received: Callable[[bytes], None],
        broken: Callable[[str], None],
        *,
        payer: str,
        opened: Callable[[], None] | None = None,
        drained: Callable[[], None] | None = None,
    ) -> None:
        self._loop = loop
        self._socket = sock
        self._received = received
        self._broken = broken
        self._opened = opened
        self._drained = drained
        self._outgoing = bytearray()
        self._reading = True
        self._live = True
        loop.watch(sock.fileno(), WRITE if opened else READ, self._ready, payer)

    @property
    def backlog(self) -> int:
        return len(self._outgoing)

    def send(self, data: bytes) -> None:
        if not self._live:
            return
        if not self._outgoing and self._opened is None:
            try:
                sent = self._socket.send(data)
            except BlockingIOError:
                sent = 0
            except OSError as error:
                self._fail(error)
                return
            data = data[sent:]
        if data:
            self._outgoing += data
            self._watch()

    def read(self, wanted: bool) -> None:
        """Switch reading on or off; the end of the connection is noticed either way."""
        if self._live and wanted != self._reading:
            self._reading = wanted
            self._watch()

    def finish(self) -> None:
        """Shut the socket for writing; no bytes may wait, except in the kernel."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)

    def take(self) -> socket.socket:
        """Return the socket, which the caller owns from now on; no bytes may wait."""
        self._live = False
        self._loop.unwatch(self._socket.fileno())
        return self._socket

    def close(self) -> None:
        if self._live:
            self._live = False
            self._loop.discard(self._socket)

    def _watch(self) -> None:
        events = READ if self._reading else HANGUP
        if self._outgoing or self._opened is not None:
            events |= WRITE
        self._loop.change(self._socket.fileno(), events)

    def _ready(self, events: int) -> None:
        if self._opened is not None:
            self._connected()
            return
        if events & WRITE:
            self._flush()
        if self._live and events & ~WRITE:
            if self._reading:
                self._receive()
            else:
                self._fail(None)

    def _connected(self) -> None:
        error = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            self._fail(OSError(error, errno.errorcode.get(error, str(error))))
            return
        opened, self._opened = self._opened, None
        self._watch()
        if opened is not None:
            opened()

    def _flush(self) -> None:
        try:
            sent = self._socket.send(self._outgoing)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(error)
            return
        del self._outgoing[:sent]
        if not self._outgoing:
            self._watch()
            if self._drained is not None:
                self._drained()

    def _receive(self) -> None:
        try:
            data = self._socket.recv(_READ_SIZE)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(error)
            return
        self._received(data)

    def _fail(self, error: OSError | None) -> None:
        self.close()
        self._broken("" if error is None else error.strerror or str(error))
