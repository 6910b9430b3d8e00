"""Who listens on which TCP port, as the kernel's tables say, in the namespace of the calling thread."""

import ipaddress
import sys
from collections.abc import Iterator
from pathlib import Path

_TCP_LISTEN = "0A"


def listening_addresses(port: int) -> tuple[str, ...]:
    """Return the addresses on which someone listens on a TCP port."""
    return tuple(sorted({address for address, number in _listeners() if number == port}))


def listening_ports() -> set[int]:
    """Return the TCP ports on which someone listens, on whatever address."""
    return {number for _, number in _listeners()}


def udp_ports_in_use() -> set[int]:
    """Return the UDP ports that someone has bound, on whatever address."""
    found = set()
    for name in ("udp", "udp6"):
        table = Path("/proc/thread-self/net", name)
        if table.exists():
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                found.add(int(line.split()[1].rpartition(":")[2], 16))
    return found


def _listeners() -> Iterator[tuple[str, int]]:
    for name in ("tcp", "tcp6"):
        table = Path("/proc/thread-self/net", name)
        if table.exists():
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                _, local, _, state, *_ = line.split()
                address, _, number = local.partition(":")
                if state == _TCP_LISTEN:
                    yield _address(address), int(number, 16)


def _address(text: str) -> str:
    """Read an address of /proc/net/tcp: words of 32 bits, each in the byte order of the machine."""
    words = [text[index : index + 8] for index in range(0, len(text), 8)]
    return str(ipaddress.ip_address(b"".join(int(word, 16).to_bytes(4, sys.byteorder) for word in words)))
