"""Sockets whose two ends are in the test's own thread: TCP for those who use them, local to the machine below.

The bytes that one end of a local socket has sent are at the other end at once. So in one thread, no result depends
on chance, and the gate allows them. `socket.socket` is replaced, for `socket.create_server`, asyncio and the product,
too, by two fixtures: `local_sockets`, and `sockets`, with which a test has real sockets at night. With them, an
asynchronous test runs in `autojump.LocalLoop`.

Every address of the machine is reachable, and a listening socket at 0.0.0.0 or :: is at each of them. Options of TCP
and IP have no effect.
"""

import errno
import itertools
import os
import socket
import struct
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

_TCP_OPTIONS = (socket.IPPROTO_TCP, socket.IPPROTO_IP, socket.IPPROTO_IPV6)
_ANYWHERE = ("0.0.0.0", "::")
_RESET = struct.pack("ii", 1, 0)  # the value of SO_LINGER with which `close` resets a connection
_FIRST_PORT = 40_000
_MAX_WAITING = 4096  # connections that are not accepted yet; a further one would block

_networks = itertools.count()
_network = ""
_ports = itertools.count(_FIRST_PORT)
_servers_ends: "weakref.WeakValueDictionary[bytes, LocalSocket]" = weakref.WeakValueDictionary()
_clients_ends: "weakref.WeakValueDictionary[bytes, LocalSocket]" = weakref.WeakValueDictionary()


class LocalSocket(socket.socket):
    """A socket of `tests/support/local_sockets.py`. Its name in the kernel contains its address."""

    def __init__(
        self,
        family: int = -1,
        type: int = -1,  # noqa: A002  the base's name, with which asyncio calls it
        proto: int = -1,
        fileno: int | None = None,
    ) -> None:
        if fileno is None:
            super().__init__(socket.AF_UNIX, socket.SOCK_STREAM if type == -1 else type)
        else:
            super().__init__(fileno=fileno)
        self._dialled: tuple[Any, ...] | None = None
        self._resets = False
        self._error = 0  # of a connection that was refused, until `getsockopt` asks for it

    def bind(self, address: Any) -> None:
        if isinstance(address, tuple):
            host, port = address[0] or _ANYWHERE[0], address[1] or next(_ports)
            address = _name(host, port)
        super().bind(address)

    def listen(self, _backlog: int = 0, /) -> None:
        super().listen(_MAX_WAITING)

    def accept(self) -> "tuple[LocalSocket, Any]":
        descriptor, name = self._accept()  # type: ignore[attr-defined]  # of the base in C
        accepted = LocalSocket(fileno=descriptor)
        if self.gettimeout():
            accepted.setblocking(True)
        if name:
            _servers_ends[name] = accepted
        return accepted, _address(name)

    def connect(self, address: Any) -> None:
        if not isinstance(address, tuple):
            super().connect(address)
            return
        host, port = address[:2]
        own = super().getsockname()
        if not own:
            super().bind(_name("::1" if ":" in host else "127.0.0.1", next(_ports), host, port))
            own = super().getsockname()
        self._dialled = address
        _clients_ends[own] = self
        for place in (host, *_ANYWHERE):
            with suppress(ConnectionRefusedError):
                super().connect(_name(place, port))
                return
        if self.gettimeout() == 0:
            self._error = errno.ECONNREFUSED
            raise BlockingIOError(errno.EINPROGRESS, os.strerror(errno.EINPROGRESS))
        raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))

    def connect_ex(self, address: Any) -> int:
        try:
            self.connect(address)
        except OSError as error:
            return error.errno or -1
        return 0

    def getsockname(self) -> Any:
        with suppress(OSError):
            _source, target = _addresses(super().getpeername())
            if target is not None:
                return target
        return _address(super().getsockname())

    def getpeername(self) -> Any:
        name = super().getpeername()
        return self._dialled or _address(name)

    def setsockopt(self, level: int, option: int, *value: Any) -> None:
        if (level, option) == (socket.SOL_SOCKET, socket.SO_LINGER):
            self._resets = value[0] == _RESET
        elif level not in _TCP_OPTIONS:
            super().setsockopt(level, option, *value)

    def getsockopt(self, level: int, option: int, *size: int) -> Any:
        if (level, option) == (socket.SOL_SOCKET, socket.SO_ERROR) and self._error:
            error, self._error = self._error, 0
            return error
        return super().getsockopt(level, option, *size)

    def close(self) -> None:
        if self._resets:
            self._reset()
        super().close()

    def _reset(self) -> None:
        """Leave a byte unread, with which the kernel resets a local connection when it closes."""
        with suppress(OSError):
            far = _servers_ends.get(super().getsockname()) or _clients_ends.get(super().getpeername())
            if far is not None:
                far.send(b"\0", socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)


def _name(host: str, port: int, *target: object) -> bytes:
    return "\0".join(map(str, ("", _network, host, port, *target))).encode()


def _addresses(name: Any) -> tuple[Any, Any]:
    """Return the address in a name, and the one that its socket has dialled, if it was not bound before."""
    if not isinstance(name, bytes) or not name:
        return name, None
    _start, _network_of, host, port, *target = name.decode().split("\0")
    return (host, int(port)), (target[0], int(target[1])) if target else None


def _address(name: Any) -> Any:
    return _addresses(name)[0]


@contextmanager
def local_sockets() -> Iterator[None]:
    """Replace `socket.socket` by the local socket of a new network."""
    global _network, _ports
    before = socket.socket, _network, _ports
    _network, _ports = f"{os.getpid()}.{next(_networks)}", itertools.count(_FIRST_PORT)
    socket.socket = LocalSocket  # type: ignore[misc]  # a class is replaced
    try:
        yield
    finally:
        socket.socket, _network, _ports = before  # type: ignore[misc]  # as above
