"""Limit the open connections: of each robot, of each address without a robot's certificate, and of all together.

A connection is counted from `accept` to `close`, so also during its TLS handshake. It counts for its address (IPv6: its
/64 network) until a robot's certificate is known, then for the robot. A connection above a limit is closed immediately.
"""

import asyncio
import contextlib
import errno
import ipaddress
import resource
import socket
from collections import Counter
from typing import Any

import structlog

from appliance.base import clock
from rosrv_fleet.config import Limits

_OTHER_FILES = 256  # open files that are not connections: uploads, the database, workers
_LEAST_CONNECTIONS = 64
_LOG_SECONDS = 60.0
_log = structlog.get_logger()


class TooFewFilesError(OSError):
    """The limit of open files is too small to serve."""


class ClientConnections:
    """The open connections by owner. Only for the event loop's thread."""

    def __init__(self, limits: Limits) -> None:
        """Raise the limit of open files as far as permitted. Raises `TooFewFilesError`."""
        self._limits = limits
        self._most = permitted_connections(limits.connections)
        self._owners: Counter[str] = Counter()
        self._open: dict[int, CountedSocket] = {}
        self._logged = 0.0

    def accepted(self, connection: "CountedSocket", address: str) -> bool:
        """Count a new connection; return False if there are too many."""
        owner = owner_of(address)
        if len(self._open) >= self._most:
            return self._refused("all", self._most)
        if self._owners[owner] >= self._limits.address_connections:
            return self._refused(owner, self._limits.address_connections)
        self._owners[owner] += 1
        connection.owner = owner
        self._open[connection.fileno()] = connection
        # A client that does not complete the handshake in this time is cut off.
        connection.due = asyncio.get_running_loop().call_later(self._limits.header_seconds, _cut, connection)
        return True

    def established(self, number: int, robot: str | None) -> bool:
        """Note that the handshake of a descriptor is complete; return False if the robot has too many connections."""
        connection = self._open[number]
        if connection.due is not None:
            connection.due.cancel()
        if robot is None:
            return True
        owner = f"robot {robot}"
        if self._owners[owner] >= self._limits.robot_connections:
            return self._refused(owner, self._limits.robot_connections)
        self._release(connection.owner)
        self._owners[owner] += 1
        connection.owner = owner
        return True

    def closed(self, number: int) -> None:
        """Note that a descriptor is closed."""
        connection = self._open.pop(number, None)
        if connection is not None:
            if connection.due is not None:
                connection.due.cancel()
            self._release(connection.owner)

    def _release(self, owner: str) -> None:
        self._owners[owner] -= 1
        if not self._owners[owner]:
            del self._owners[owner]

    def _refused(self, owner: str, most: int) -> bool:
        if clock.now() - self._logged > _LOG_SECONDS:
            self._logged = clock.now()
            _log.warning("connections are refused", owner=owner, limit=most)
        return False


class CountedSocket(socket.socket):
    """A connection that is counted until it is closed."""

    table: ClientConnections
    owner = ""
    due: asyncio.TimerHandle | None = None

    def close(self) -> None:
        """Close the connection."""
        if self.fileno() >= 0:
            self.table.closed(self.fileno())
        super().close()


class CountingListener(socket.socket):
    """A listening socket that closes each connection above its owner's limit."""

    table: ClientConnections

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection. Raises `ConnectionAbortedError` if it was above a limit and is closed."""
        number, address = self._accept()  # type: ignore[attr-defined]  # `socket.accept` also calls it
        connection = CountedSocket(self.family, self.type, self.proto, fileno=number)
        connection.table = self.table
        if not self.table.accepted(connection, str(address[0])):
            connection.close()
            raise ConnectionAbortedError(errno.ECONNABORTED, "too many connections", address[0])
        return connection, address


def listen(host: str, port: int, table: ClientConnections) -> CountingListener:
    """Return a listening socket. Raises `OSError`."""
    (family, kind, protocol, _name, address), *_others = socket.getaddrinfo(
        host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )
    listener = CountingListener(family, kind, protocol)
    listener.table = table
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise OSError(error.errno, f"{host}:{port}: {error.strerror}; change listen") from error
    return listener


def owner_of(address: str) -> str:
    """Return the owner of connections from an address: an IPv4 address itself, the /64 network of an IPv6 address."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address) and parsed.ipv4_mapped is None:
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address


def permitted_connections(wanted: int) -> int:
    """Raise the limit of open files; return how many connections it permits. Raises `TooFewFilesError`."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = wanted + _OTHER_FILES
    files = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    most = files - _OTHER_FILES
    if most < _LEAST_CONNECTIONS:
        raise TooFewFilesError(
            f"only {files} files may be open: raise the limit (LimitNOFILE, ulimit -n) to {needed}"
        )
    if most < wanted:
        _log.warning(
            "the limit of open files permits fewer connections", connections=most, wanted=wanted, files=files,
            advice=f"raise LimitNOFILE or ulimit -n to {needed}",
        )  # fmt: skip
    return most


def _cut(connection: CountedSocket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
