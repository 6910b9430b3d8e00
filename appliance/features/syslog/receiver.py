"""Connections to the receiver: UDP (RFC 5426), TCP with octet counting (RFC 6587), TLS (RFC 5425).

`send` returns when the receiver's kernel has acknowledged every byte (TCP, TLS), or the datagrams have left
(UDP). A closed connection is detected before more is sent. With TLS, the configured authority certifies the
receiver's configured name or address. Syslog has no acknowledgements, so messages that a dying receiver accepted
are lost; checkpoints reveal the gap.
"""

import fcntl
import select
import socket
import ssl
import struct
import termios
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Protocol

from appliance.base import clock
from appliance.base.input_files import path_for_library

_CONNECT_SECONDS = 5.0
_SEND_SECONDS = 10.0
_OBJECTION_SECONDS = 1.0
_LOOK_SECONDS = (0.001, 0.02)  # first and longest interval between two checks for acknowledgement


class Receiver(Protocol):
    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages in order, with the module's invariants. Raises `OSError`."""

    def close(self) -> None: ...


class DatagramReceiver:
    """A UDP receiver. A closed port is not always reported, so messages may be lost."""

    def __init__(self, host: str, port: int) -> None:
        self._place = (host, port)
        self._socket: socket.socket | None = None

    def send(self, messages: Sequence[bytes]) -> None:
        if self._socket is None:
            family = socket.AF_INET6 if ":" in self._place[0] else socket.AF_INET
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.settimeout(_SEND_SECONDS)
            self._socket.connect(self._place)
        for message in messages:
            self._socket.send(message)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class StreamReceiver:
    """A receiver by one lasting connection; `context` returns a new connection's TLS context (None: clear text)."""

    def __init__(
        self,
        host: str,
        port: int,
        context: Callable[[], ssl.SSLContext] | None = None,
        name: str | None = None,
    ) -> None:
        self._place = (host, port)
        self._context = context
        self._name = name or host
        self._socket: socket.socket | None = None

    def send(self, messages: Sequence[bytes]) -> None:
        connection = self._socket
        if connection is None:
            connection = self._socket = self._connect()
        _require_open(connection)
        connection.settimeout(_SEND_SECONDS)
        connection.sendall(b"".join(b"%d %b" % (len(message), message) for message in messages))
        _await_acknowledgement(connection)

    def _connect(self) -> socket.socket:
        connection = socket.create_connection(self._place, _CONNECT_SECONDS)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._context is not None:
                connection = self._context().wrap_socket(connection, server_hostname=self._name)
                _await_objection(connection)
        except BaseException:
            connection.close()
            raise
        return connection

    def close(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
            self._socket = None


def tls_context(ca: Path | None, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """Return a new context. Without `ca`, the system's authorities verify the receiver."""
    try:
        with nullcontext() if ca is None else path_for_library(ca) as authority:
            context = ssl.create_default_context(cafile=authority)
    except OSError as error:
        raise OSError(f"{ca}: {error.strerror or error}: the authority cannot be read") from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if certificate is not None:
        try:
            with path_for_library(certificate) as chain, path_for_library(key or certificate) as private:
                context.load_cert_chain(chain, private)
        except OSError as error:
            raise OSError(
                f"{certificate}, {key}: {error.strerror or error}: the forwarder's own certificate cannot be read"
            ) from error
    return context


def _await_objection(connection: socket.socket) -> None:
    """Wait for the server's rejection of our certificate, which in TLS 1.3 comes after our handshake."""
    _is_readable(connection, _OBJECTION_SECONDS)
    _require_open(connection)


def _is_readable(connection: socket.socket, seconds: float) -> bool:
    poll = select.poll()  # `select` takes no descriptor above 1023
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(seconds * 1000))


def _require_open(connection: socket.socket) -> None:
    connection.settimeout(0)
    try:
        while True:
            if not connection.recv(4096):
                raise ConnectionResetError("the receiver closed the connection")
    except (BlockingIOError, ssl.SSLWantReadError):
        return


def _await_acknowledgement(connection: socket.socket) -> None:
    deadline = clock.now() + _SEND_SECONDS
    pause, longest = _LOOK_SECONDS
    while _unacknowledged(connection):
        if clock.now() > deadline:
            raise TimeoutError(f"the receiver took nothing for {_SEND_SECONDS:g} s")
        if _is_readable(connection, pause):
            _require_open(connection)
        pause = min(2 * pause, longest)


def _unacknowledged(connection: socket.socket) -> int:
    answer = fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, b"\0\0\0\0")
    return int(struct.unpack("i", answer)[0])
