"""Reports of the kernel about changes in nftables, as bytes of netlink."""

import struct

CHAIN_REMOVED, RULE_ADDED, ELEMENT_ADDED = 5, 6, 12


def report(kind: int, table: str) -> bytes:
    return _message(kind, (1, table))


def generation(program: str) -> bytes:
    return _message(15, (3, program))


def _message(kind: int, attribute: tuple[int, str]) -> bytes:
    number, text = attribute
    value = text.encode() + b"\0"
    body = struct.pack("=HH", 4 + len(value), number) + value
    body += b"\0" * (-len(body) % 4)
    return struct.pack("=IHHIIBBH", 20 + len(body), 10 << 8 | kind, 0, 0, 0, 1, 0, 0) + body
