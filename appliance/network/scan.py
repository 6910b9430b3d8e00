"""A TCP port scan: which ports of a machine accept a connection from here.

Many connections are attempted at once, without waiting for one another; each has its own time limit, so
the whole scan is bounded by `len(ports) / AT_ONCE * seconds`. An open connection is reset at once and
carries nothing.
"""

import contextlib
import errno
import os
import resource
import selectors
import socket
import struct
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from appliance.network.namespaces import NetworkError

AT_ONCE = 256  # connections, fewer where the process may not open as many files
_OTHER_FILES = 32
_REFUSED = (errno.ECONNREFUSED, errno.ECONNRESET)
_SILENT = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class ScanResult:
    """What the ports of one address answered."""

    address: str
    open: tuple[int, ...]
    refused: int  # ports that answered with a reset
    silent: int  # ports that did not answer in time, or that the network said cannot be reached

    @property
    def answered(self) -> bool:
        """The machine gave some answer, so it is there."""
        return bool(self.open) or self.refused > 0


def addresses_of(host: str) -> tuple[str, ...]:
    """Return the addresses of a host, all of them other machines.

    Raises: NetworkError if the name is unknown, or one of the addresses is this machine's own.
    """
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise NetworkError(f"the host {host!r} is not known: {error.strerror}") from error
    addresses = tuple(dict.fromkeys(str(entry[4][0]) for entry in found))
    for address in addresses:
        if _is_own(address):
            raise NetworkError(
                f"{address} is this machine, whose own connections are always accepted: "
                "run the check on another machine of the network"
            )
    return addresses


def scan(address: str, ports: Iterable[int], seconds: float) -> ScanResult:
    """Try to connect to each port, at most `seconds` each."""
    waiting, opened = iter(ports), []
    refused = silent = 0
    with selectors.DefaultSelector() as selector:
        pending: dict[socket.socket, tuple[int, float]] = {}
        try:
            while _fill(selector, pending, waiting, address, seconds):
                for client, outcome in _outcomes(selector, pending):
                    port, _ = pending.pop(client)
                    selector.unregister(client)
                    client.close()
                    if outcome == 0:
                        opened.append(port)
                    elif outcome in _REFUSED:
                        refused += 1
                    elif outcome in _SILENT:
                        silent += 1
                    else:
                        raise NetworkError(f"scanning {address} port {port}: {os.strerror(outcome)}")
        finally:
            for client in pending:
                client.close()
    return ScanResult(address, tuple(sorted(opened)), refused, silent)


def _fill(
    selector: selectors.BaseSelector,
    pending: dict[socket.socket, tuple[int, float]],
    ports: Iterator[int],
    address: str,
    seconds: float,
) -> bool:
    """Start connections until AT_ONCE are under way; tell whether there are any."""
    at_once = max(1, min(AT_ONCE, resource.getrlimit(resource.RLIMIT_NOFILE)[0] - _OTHER_FILES))
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    while len(pending) < at_once and (port := next(ports, None)) is not None:
        client = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        pending[client] = (port, time.monotonic() + seconds)
        selector.register(client, selectors.EVENT_WRITE)
        with contextlib.suppress(OSError):  # in progress, or its outcome is read from the socket
            client.connect((address, port))
    return bool(pending)


def _outcomes(
    selector: selectors.BaseSelector, pending: dict[socket.socket, tuple[int, float]]
) -> list[tuple[socket.socket, int]]:
    """Wait for the first outcome or deadline; return the sockets that are done with their error number."""
    now = time.monotonic()
    limit = max(0.0, min(deadline for _, deadline in pending.values()) - now)
    done: list[tuple[socket.socket, int]] = []
    for key, _ in selector.select(limit):
        client = key.fileobj
        if isinstance(client, socket.socket):
            done.append((client, client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)))
    settled = {client for client, _ in done}
    now = time.monotonic()
    late = [client for client, (_, deadline) in pending.items() if deadline <= now and client not in settled]
    return done + [(client, errno.ETIMEDOUT) for client in late]


def _is_own(address: str) -> bool:
    """A machine reaches its own addresses with themselves as source."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))
        except OSError:
            return False  # no way there: the scan will say so
        return str(probe.getsockname()[0]) == address
