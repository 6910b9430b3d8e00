"""Find the TCP ports of a machine that accept a connection from here.

1. If a connection fails before a packet leaves (no route, a rule of this machine), it is unknown whether the port is
   open; only the result of `connect` shows this.
2. If some ports answer, each silent port is tried once more: the first packet may have been lost.
"""

import errno
import math
import os
import resource
import select
import socket
import struct
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from appliance.network.namespaces import NetworkError

AT_ONCE = 256  # connections; fewer if the process may not open as many files
_REFUSED = (errno.ECONNREFUSED, errno.ECONNRESET)
_UNDER_WAY = (0, errno.EINPROGRESS)
_SILENT = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class ScanResult:
    """The open and the untested ports of one address."""

    address: str
    open: tuple[int, ...]
    refused: int  # ports that answered with a reset
    silent: int  # ports without an answer in time, or unreachable; if others answered, at two attempts
    untried: int = 0  # ports to which no packet could be sent from here
    obstacle: str = ""  # why the last untried port could not be tried

    @property
    def answered(self) -> bool:
        return bool(self.open) or self.refused > 0


def addresses_of(host: str) -> tuple[str, ...]:
    """Return the addresses of a host. Raises `NetworkError` for an unknown name or an own address."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise NetworkError(f"the host {host!r} is unknown: {error.strerror}; give its address") from error
    addresses = tuple(dict.fromkeys(str(entry[4][0]) for entry in found))
    for address in addresses:
        if _is_own(address):
            raise NetworkError(
                f"{address} is this machine, whose own connections are always accepted: "
                "run the check on another machine of the network"
            )
    return addresses


def scan(address: str, ports: Iterable[int], seconds: float) -> ScanResult:
    """Try to connect to each port. Raises `NetworkError` for an unusable address."""
    first, silent = _scan(address, ports, seconds)
    if not (first.answered and silent):
        return first
    again, _ = _scan(address, silent, seconds)
    return ScanResult(
        address,
        tuple(sorted((*first.open, *again.open))),
        first.refused + again.refused,
        again.silent,
        first.untried + again.untried,
        again.obstacle or first.obstacle,
    )


def _scan(address: str, ports: Iterable[int], seconds: float) -> tuple[ScanResult, list[int]]:
    """Try each port once; return also the silent ports."""
    wanted = list(ports)
    opened: list[int] = []
    silent: list[int] = []
    refused = untried = 0
    obstacle = ""
    pool = ThreadPoolExecutor(_at_once(), "scan")
    try:
        for port, (sent, outcome) in zip(
            wanted, pool.map(lambda port: _try(address, port, seconds), wanted), strict=True
        ):
            if outcome == 0:
                opened.append(port)
            elif outcome in _REFUSED:
                refused += 1
            elif outcome not in _SILENT:
                raise NetworkError(f"scanning {address} port {port}: {os.strerror(outcome)}")
            elif sent:
                silent.append(port)
            else:
                untried, obstacle = untried + 1, os.strerror(outcome)
    except OSError as error:
        raise NetworkError(f"scanning {address}: {error.strerror}") from error
    finally:
        pool.shutdown(cancel_futures=True)
    return ScanResult(address, tuple(sorted(opened)), refused, len(silent), untried, obstacle), silent


def longest(ports: int, seconds: float) -> float:
    return math.ceil(ports / _at_once()) * seconds


def _at_once() -> int:
    used = len(os.listdir("/proc/self/fd"))  # noqa: PTH208  only their number counts
    return max(1, min(AT_ONCE, resource.getrlimit(resource.RLIMIT_NOFILE)[0] - used))


def _try(address: str, port: int, seconds: float) -> tuple[bool, int]:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        outcome = client.connect_ex((address, port))
        if outcome not in _UNDER_WAY:
            return False, outcome
        poll = select.poll()
        poll.register(client, select.POLLOUT)
        if not poll.poll(seconds * 1000):
            return True, errno.ETIMEDOUT
        return True, client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)


def _is_own(address: str) -> bool:
    """Return whether the address is our own: packets to it would also have it as source."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((address, 9))
            return str(probe.getsockname()[0]) == address
    except OSError:
        return False  # no route: the scan reports it
