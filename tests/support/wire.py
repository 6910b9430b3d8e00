"""Capture and send raw frames on an Ethernet of the lab, below every firewall."""

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from appliance.network.namespaces import Namespace
from examples.landshark.lab import INTERFACE, Host
from tests.support.processes import LIMIT

_EVERYTHING = 0x0003  # ETH_P_ALL
_OWN = 4  # PACKET_OUTGOING
_UDP = 17
_UNREACHABLE = 3  # of ICMP
_RCVBUFFORCE = 33  # SO_RCVBUFFORCE: beyond the limit of the system, for root


@dataclass(frozen=True)
class Frame:
    data: bytes

    @property
    def ipv4(self) -> bool:
        return self.data[12:14] == b"\x08\x00"

    @property
    def arp(self) -> bool:
        return self.data[12:14] == b"\x08\x06"

    @property
    def source(self) -> str:
        return socket.inet_ntoa(self.data[26:30])

    @property
    def destination(self) -> str:
        return socket.inet_ntoa(self.data[30:34])

    @property
    def protocol(self) -> int:
        return self.data[23]

    @property
    def header(self) -> int:
        return 14 + (self.data[14] & 15) * 4

    @property
    def ports(self) -> tuple[int, int]:
        start = self.header
        return (
            int.from_bytes(self.data[start : start + 2]),
            int.from_bytes(self.data[start + 2 : start + 4]),
        )

    @property
    def returned(self) -> "Frame | None":
        """Return the beginning of the packet that an ICMP error quotes, or None for other packets."""
        if self.protocol != socket.IPPROTO_ICMP or self.data[self.header] != _UNREACHABLE:
            return None
        return Frame(self.data[:14] + self.data[self.header + 8 :])

    @property
    def udp_payload(self) -> bytes:
        start = self.header
        length = int.from_bytes(self.data[start + 4 : start + 6])
        return self.data[start + 8 : start + length]

    def with_payload(self, payload: bytes) -> bytes:
        """Return the packet with another payload, and like a captured frame without a UDP checksum."""
        start = self.header
        head = self.data[: start + 6] + bytes(2)
        assert len(payload) == len(self.udp_payload)
        return head + payload

    @property
    def esp(self) -> bool:
        return (
            self.ipv4
            and self.protocol == _UDP
            and 4500 in self.ports
            and len(self.udp_payload) > 8
            and self.udp_payload[:4] != bytes(4)
        )


class Capture:
    def __init__(self, namespace: Namespace, interface: str = INTERFACE) -> None:
        self.frames: list[Frame] = []
        self._changed = threading.Condition()
        self._ended = False
        with namespace.inside():
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_EVERYTHING))
        self._socket.setsockopt(
            socket.SOL_SOCKET, _RCVBUFFORCE, 32 << 20
        )  # bytes; a busy machine reads it late
        self._socket.bind((interface, 0))
        self._socket.settimeout(0.1)
        self._thread = threading.Thread(target=self._read, name="capture", daemon=True)

    def wait_for(self, wanted: Callable[[Frame], bool], *, since: int = 0, timeout: float = LIMIT) -> Frame:
        with self._changed:
            found = self._changed.wait_for(
                lambda: next((frame for frame in self.frames[since:] if wanted(frame)), None), timeout
            )
        assert found is not None, f"no such frame among {len(self.frames) - since}"
        return found

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._ended = True
        self._thread.join()
        self._socket.close()

    def _read(self) -> None:
        while not self._ended:
            try:
                data = self._socket.recv(1 << 16)
            except TimeoutError:
                continue
            with self._changed:
                self.frames.append(Frame(data))
                self._changed.notify_all()


def hardware_address(host: Host) -> bytes:
    with host.entered(), socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as raw:
        raw.bind((INTERFACE, 0))
        return bytes(raw.getsockname()[4])


def send_frames(host: Host, frames: list[bytes]) -> None:
    own = hardware_address(host)
    with host.entered(), socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as raw:
        raw.bind((INTERFACE, 0))
        for frame in frames:
            raw.send(frame[:6] + own + frame[12:])


def udp_packet(source: tuple[str, int], destination: tuple[str, int], payload: bytes) -> bytes:
    udp = (
        source[1].to_bytes(2)
        + destination[1].to_bytes(2)
        + (8 + len(payload)).to_bytes(2)
        + bytes(2)
        + payload
    )
    head = bytes([0x45, 0]) + (20 + len(udp)).to_bytes(2) + bytes(4) + bytes([64, _UDP]) + bytes(2)
    head += socket.inet_aton(source[0]) + socket.inet_aton(destination[0])
    return head[:10] + _checksum(head) + head[12:] + udp


def _checksum(header: bytes) -> bytes:
    total = sum(int.from_bytes(header[i : i + 2]) for i in range(0, len(header), 2))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return (~total & 0xFFFF).to_bytes(2)


def connect(host: Host, source: str, target: str, port: int = 11311) -> str:
    def work() -> str:
        with socket.socket() as client:
            client.settimeout(4)
            client.bind((source, 0))
            try:
                client.connect((target, port))
            except TimeoutError:
                return "nothing"
            except ConnectionRefusedError:
                return "refused"
            return "connected"

    return host.run(work)
