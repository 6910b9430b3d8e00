"""A TCP port scan: which ports of a machine accept a connection from here.

Many connections are attempted at once, without waiting for one another; each has its own time limit, so
the whole scan is bounded by `len(ports) / AT_ONCE * seconds`. An open connection is reset at once and
carries nothing.

A connection that fails before a packet leaves (no way to the network, a rule of this machine's own) says nothing of
the port: it is neither open nor closed. Its outcome is what `connect` returned; the socket shows none later.
"""

import errno
import os
import resource
import selectors
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from appliance.network.namespaces import NetworkError

AT_ONCE = 256  # connections, fewer where the process may not open as many files
_OTHER_FILES = 32
_REFUSED = (errno.ECONNREFUSED, errno.ECONNRESET)
_UNDER_WAY = (0, errno.EINPROGRESS)
_SILENT = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class ScanResult:
    """What the ports of one address answered."""

    address: str
    open: tuple[int, ...]
    refused: int  # ports that answered with a reset
    silent: int  # ports that did not answer in time, or that the network said cannot be reached
    untried: int = 0  # ports to which no packet could be sent from here
    obstacle: str = ""  # why, of the last of them

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
    """Try to connect to each port, at most `seconds` each.

    Raises: NetworkError for an address that this machine cannot use, or an outcome that says nothing of a port.
    """
    attempts, waiting = _Attempts(address, seconds), deque(ports)
    with selectors.DefaultSelector() as selector:
        try:
            while attempts.start(selector, waiting):
                for client, outcome in _outcomes(selector, attempts.pending):
                    attempts.settle(selector, client, outcome)
        finally:
            for client in attempts.pending:
                client.close()
    return attempts.result()


class _Attempts:
    """The connections of one scan: those under way, and what became of the others."""

    def __init__(self, address: str, seconds: float) -> None:
        self.pending: dict[socket.socket, tuple[int, float]] = {}  # port and deadline
        self._address, self._seconds = address, seconds
        self._family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._opened: list[int] = []
        self._refused = self._silent = self._untried = 0
        self._obstacle = ""

    def start(self, selector: selectors.BaseSelector, ports: deque[int]) -> bool:
        """Start connections until AT_ONCE are under way, or all that the process may have; whether there are any."""
        at_once = max(1, min(AT_ONCE, resource.getrlimit(resource.RLIMIT_NOFILE)[0] - _OTHER_FILES))
        while len(self.pending) < at_once and ports and (client := self._socket()) is not None:
            port = ports.popleft()
            outcome = client.connect_ex((self._address, port))
            if outcome in _UNDER_WAY:
                self.pending[client] = (port, time.monotonic() + self._seconds)
                selector.register(client, selectors.EVENT_WRITE)
                continue
            client.close()
            if outcome in _SILENT:
                self._untried += 1
                self._obstacle = os.strerror(outcome)
            else:
                self._count(port, outcome)
        return bool(self.pending)

    def settle(self, selector: selectors.BaseSelector, client: socket.socket, outcome: int) -> None:
        """Take the outcome of a connection that was under way."""
        port, _ = self.pending.pop(client)
        selector.unregister(client)
        client.close()
        self._count(port, outcome)

    def result(self) -> ScanResult:
        """What was seen."""
        opened = tuple(sorted(self._opened))
        return ScanResult(self._address, opened, self._refused, self._silent, self._untried, self._obstacle)

    def _count(self, port: int, outcome: int) -> None:
        if outcome == 0:
            self._opened.append(port)
        elif outcome in _REFUSED:
            self._refused += 1
        elif outcome in _SILENT:
            self._silent += 1
        else:
            raise NetworkError(f"scanning {self._address} port {port}: {os.strerror(outcome)}")

    def _socket(self) -> socket.socket | None:
        """A socket; None where there can be one only when a connection that is under way has ended."""
        try:
            client = socket.socket(self._family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE) and self.pending:
                return None
            raise NetworkError(f"scanning {self._address}: {error.strerror}") from error
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        return client


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
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((address, 9))
            return str(probe.getsockname()[0]) == address
    except OSError:
        return False  # no way there: the scan will say so
