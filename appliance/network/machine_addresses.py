"""Read the addresses of this machine from /proc, in the thread's network namespace: cheap enough for each second."""

import ipaddress
from collections.abc import Iterator
from pathlib import Path

_NET = Path("/proc/thread-self/net")
_GLOBAL_SCOPE = "00"
_MAX = 64  # a machine of containers has one for each of its bridges


def machine_addresses(net: Path = _NET) -> tuple[str, ...]:
    """Return the addresses, sorted, without loopback and IPv6 link-local ones; only the first 64 of a family."""
    found4 = sorted(set(_ipv4(_text(net / "fib_trie"))), key=int)
    found6 = sorted(set(_ipv6(_text(net / "if_inet6"))), key=int)
    return tuple(sorted(map(str, (*found4[:_MAX], *found6[:_MAX]))))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except OSError:  # the kernel lacks the family
        return ""


def _ipv4(trie: str) -> Iterator[ipaddress.IPv4Address]:
    address = ""
    for line in trie.splitlines():
        words = line.split()
        if words[:1] == ["|--"]:
            address = words[1]
        elif words == ["/32", "host", "LOCAL"] and not address.startswith("127."):
            yield ipaddress.IPv4Address(address)


def _ipv6(table: str) -> Iterator[ipaddress.IPv6Address]:
    for line in table.splitlines():
        number, _index, _length, scope, *_ = line.split()
        if scope == _GLOBAL_SCOPE:
            yield ipaddress.IPv6Address(int(number, 16))
