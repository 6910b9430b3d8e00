"""Read the kernel's tables of sockets in the calling thread's network namespace."""

import ipaddress
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_TCP_ESTABLISHED, _TCP_SYN_RECV, _TCP_LISTEN = "01", "03", "0A"


def listening_addresses(port: int) -> tuple[str, ...]:
    return tuple(sorted({_address(row.address) for row in _listeners() if row.port == port}))


def listening_ports() -> set[int]:
    return {row.port for row in _listeners()}


def listening_inodes(port: int) -> set[str]:
    return {row.inode for row in _listeners() if row.port == port}


def tcp_inodes() -> frozenset[str]:
    """Return the inodes of TCP sockets that a process has; cheap enough for each second."""
    return frozenset(row.inode for row in _rows("tcp", "tcp6"))


def udp_ports_in_use() -> set[int]:
    return {row.port for row in _rows("udp", "udp6")}


class TcpSocket(NamedTuple):
    """A TCP socket. `version` is that of its family, so a socket for both has an IPv4 address mapped into IPv6.

    `half_open`: the peer has still to answer our SYN-ACK.
    """

    version: int
    address: str
    port: int
    peer: str
    peer_port: int
    listens: bool
    established: bool
    inode: str
    half_open: bool = False
    uid: int = 0
    """The user of this end."""

    @property
    def peer_address(self) -> str:
        """The peer's address, as IPv4 if it is mapped into IPv6."""
        return _unmap(self.peer)

    @property
    def local_address(self) -> str:
        return _unmap(self.address)


def tcp_sockets() -> list[TcpSocket]:
    return [
        TcpSocket(
            6 if name == "tcp6" else 4, _address(row.address), row.port, _address(peer), int(peer_port, 16),
            row.state == _TCP_LISTEN, row.state == _TCP_ESTABLISHED, row.inode, row.state == _TCP_SYN_RECV, row.uid,
        )
        for name in ("tcp", "tcp6")
        for row in _rows(name)
        for peer, _, peer_port in [row.peer.partition(":")]
    ]  # fmt: skip


class _Row(NamedTuple):
    address: str
    port: int
    peer: str
    state: str
    uid: int
    inode: str


def _listeners() -> Iterator[_Row]:
    return (row for row in _rows("tcp", "tcp6") if row.state == _TCP_LISTEN)


def _rows(*names: str) -> Iterator[_Row]:
    for name in names:
        table = Path("/proc/thread-self/net", name)
        if table.exists():
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                fields = line.split()
                address, _, port = fields[1].partition(":")
                yield _Row(address, int(port, 16), fields[2], fields[3], int(fields[7]), fields[9])


def _address(text: str) -> str:
    """Return an address of /proc/net/tcp, which has words of 32 bits in the machine's byte order."""
    words = [text[index : index + 8] for index in range(0, len(text), 8)]
    return str(ipaddress.ip_address(b"".join(int(word, 16).to_bytes(4, sys.byteorder) for word in words)))


def _unmap(text: str) -> str:
    address = ipaddress.ip_address(text)
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)
