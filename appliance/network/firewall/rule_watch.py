"""Hear from the kernel that tables of nftables change, as `nft monitor` does.

The kernel reports the changes of a transaction one after the other, and at its end the new generation with the program
that made it. Rules of iptables-nft are among them, those of iptables-legacy are not.
"""

import errno
import socket
import struct
from collections.abc import Iterator

from appliance.network.namespaces import Namespace

_NETLINK_NETFILTER, _NFTABLES_GROUP = 12, 1 << 6  # NFNLGRP_NFTABLES is 7
_SUBSYSTEM = 10  # NFNL_SUBSYS_NFTABLES
_NEW_GENERATION = 15
_ELEMENTS = (12, 14)  # additions to sets and removals, which happen all the time
_HEAD = struct.Struct("=IHHIIBBH")  # struct nlmsghdr, struct nfgenmsg
_ATTRIBUTE = struct.Struct("=HH")
_TABLE = 1  # the attribute of each message but that of a generation
_PROGRAM = 3  # the attribute of a generation
_MAX_BYTES = 1 << 17
_BUFFER = 1 << 20


class RuleWatch:
    """Hears changes of some tables by a socket of `subscribe`; without names, of all."""

    def __init__(self, opened: socket.socket, tables: frozenset[str] = frozenset()) -> None:
        self._tables = tables
        self._touched = False  # in the transaction whose messages are being read
        self._socket = opened

    def fileno(self) -> int:
        return self._socket.fileno()

    def changes(self) -> list[str]:
        """Return the program of each transaction since the last call that changed one of the tables."""
        changes: list[str] = []
        while True:
            try:
                data = self._socket.recv(_MAX_BYTES)
            except BlockingIOError:
                return changes
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                self._touched = False
                changes.append("")  # reports were lost
            else:
                changes += self._read(data)

    def close(self) -> None:
        self._socket.close()

    def _read(self, data: bytes) -> Iterator[str]:
        for kind, attributes in _messages(data):
            if kind == _NEW_GENERATION:
                if self._touched:
                    yield _text(attributes.get(_PROGRAM, b""))
                self._touched = False
            elif kind not in _ELEMENTS:
                table = _text(attributes.get(_TABLE, b""))
                self._touched = self._touched or not self._tables or table in self._tables


def subscribe(namespace: Namespace) -> socket.socket:
    """Return a socket that hears the changes in a namespace. Raises `OSError`."""
    return namespace.run(_subscribe)


def _subscribe() -> socket.socket:
    opened = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_NETFILTER)
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    opened.bind((0, _NFTABLES_GROUP))
    return opened


def _messages(data: bytes) -> Iterator[tuple[int, dict[int, bytes]]]:
    place = 0
    while place + _HEAD.size <= len(data):
        length, kind, *_ = _HEAD.unpack_from(data, place)
        if length < _HEAD.size:
            return
        if kind >> 8 == _SUBSYSTEM:
            yield kind & 0xFF, dict(_attributes(data[place + _HEAD.size : place + length]))
        place += _align(length)


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, place)
        if length < _ATTRIBUTE.size:
            return
        yield kind & 0x3FFF, data[place + _ATTRIBUTE.size : place + length]
        place += _align(length)


def _align(length: int) -> int:
    return (length + 3) & ~3


def _text(value: bytes) -> str:
    return value.rstrip(b"\0").decode("utf-8", "replace")
