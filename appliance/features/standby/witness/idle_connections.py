"""Resets of connections with an appliance that is no longer admitted."""

import contextlib
import os
import socket
import struct
from typing import Iterable, List, Set, Tuple

from appliance.features.standby.witness.firewall_rules import MARK
from appliance.features.standby.witness.settings import WitnessSettings

RESET_SECONDS = 0.6  # between two rounds: a kernel answers one segment outside the window each half second
_RESET_ROUNDS = 8
_SO_MARK = 36  # a socket option that Python 3.5 does not name
_NETFILTER, _CT_DELETE, _NLM_REQUEST = 12, 0x102, 1
# States in /proc/net/tcp: the peer may still send; it has not answered yet.
_ESTABLISHED, _CONNECTING = ("01", "03", "04", "05", "06", "08"), ("02",)
_ACK, _SYN = 0x10, 0x02
_MAPPED = "0000000000000000FFFF0000"  # an IPv4 address in /proc/net/tcp6

Ends = Tuple[str, int, str, int]  # of a connection: the own address and port, those of the peer


def sockets_with(
    addresses: Set[str], tables: List[str], states: Tuple[str, ...] = _ESTABLISHED
) -> List[Ends]:
    sockets = []
    for line in [line for table in tables for line in table.splitlines()[1:]]:
        fields = line.split()
        if fields[3] in states:
            (own, own_port), (peer, peer_port) = (_end(fields[1]), _end(fields[2]))
            if peer in addresses:
                sockets.append((own, own_port, peer, peer_port))
    return sockets


def _end(text: str) -> Tuple[str, int]:
    address, _, port = text.partition(":")
    if address.startswith(_MAPPED):
        address = address[len(_MAPPED) :]
    if len(address) != 8:
        return "", 0
    return socket.inet_ntoa(struct.pack("=I", int(address, 16))), int(port, 16)


def segment(connection: Ends, flags: int, number: int) -> bytes:
    own, own_port, peer, peer_port = connection
    ends = socket.inet_aton(peer) + socket.inet_aton(own)
    tcp = struct.pack("!HHIIBBHHH", peer_port, own_port, number, number, 5 << 4, flags, 0, 0, 0)
    words = struct.unpack("!16H", ends + struct.pack("!BBH", 0, socket.IPPROTO_TCP, len(tcp)) + tcp)
    total = sum(words)
    total = (total & 0xFFFF) + (total >> 16)
    checksum = ~(total + (total >> 16)) & 0xFFFF
    header = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(tcp), 0, 0, 64, socket.IPPROTO_TCP, 0)
    return header + ends + tcp[:16] + struct.pack("!H", checksum) + tcp[18:]


def forgetting(connection: Ends) -> bytes:
    """Return the message that deletes a connection from the kernel's connection tracker (ctnetlink)."""
    own, own_port, peer, peer_port = connection
    addresses = _attribute(1, socket.inet_aton(own)) + _attribute(2, socket.inet_aton(peer))
    ports = _attribute(2, struct.pack("!H", own_port)) + _attribute(3, struct.pack("!H", peer_port))
    ends = _nest(1, addresses) + _nest(2, _attribute(1, struct.pack("!B", socket.IPPROTO_TCP)) + ports)
    body = struct.pack("!BBH", socket.AF_INET, 0, 0) + _nest(1, ends)
    return struct.pack("=IHHII", 16 + len(body), _CT_DELETE, _NLM_REQUEST, 0, 0) + body


def forget(connections: List[Ends]) -> None:
    """Delete connections from the connection tracker, if this kernel has its interface."""
    kernel = (socket.AF_NETLINK, socket.SOCK_RAW, _NETFILTER)
    with contextlib.suppress(OSError), socket.socket(*kernel) as tracker:
        for connection in connections:
            tracker.send(forgetting(connection))


def _attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + b"\0" * (-len(value) % 4)


def _nest(kind: int, attributes: bytes) -> bytes:
    return _attribute(kind | 0x8000, attributes)


class IdleConnections:
    """Resets local connections with an appliance that is no longer admitted, even idle ones.

    For an idle connection, the witness sends its local socket a segment outside its window; the firewall rejects the
    acknowledgement with a reset. A socket that still waits for the answer to its first packet repeats that packet
    only after 1, 3 and 7 seconds; the witness sends it such a packet, whose answer is rejected likewise.

    For ten seconds after a reset, the connection tracker would lead a new connection from the same port to the earlier
    appliance, so reset connections are deleted from it.
    """

    def __init__(self, settings: WitnessSettings) -> None:
        self._settings = settings
        self._raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        self._raw.setsockopt(socket.SOL_SOCKET, _SO_MARK, MARK)
        self._raw.setblocking(False)
        self._left = []  # type: List[Ends]
        self._rounds = 0

    def connecting(self) -> List[Ends]:
        return sockets_with(self._addresses(""), _socket_tables(), _CONNECTING)

    def reset(self, admitted: str, connecting: Iterable[Ends] = ()) -> None:
        """Begin to reset the connections.

        `connecting` wait for a first answer since before the rules changed, so the connection tracker leads their
        first packet to the earlier appliance for good.
        """
        addresses = self._addresses(admitted)
        self._left = sockets_with(addresses, _socket_tables())
        self._left += [ends for ends in connecting if ends[2] in addresses]
        self._rounds = _RESET_ROUNDS
        self.go_on()

    def go_on(self) -> bool:
        if not self._left:
            return False
        peers, tables = {peer for _, _, peer, _ in self._left}, _socket_tables()
        present = dict.fromkeys(sockets_with(peers, tables), _ACK)
        present.update((ends, _SYN) for ends in sockets_with(peers, tables, _CONNECTING))
        forget([ends for ends in self._left if ends not in present])
        self._left = [ends for ends in self._left if ends in present]
        self._rounds -= 1
        for ends in self._left:
            number = struct.unpack("!I", os.urandom(4))[0]
            try:
                self._raw.sendto(segment(ends, present[ends], number), (ends[0], 0))
            except OSError:
                continue  # the next round sends it again
        if self._rounds <= 0:
            self._left = []
        return bool(self._left)

    def _addresses(self, admitted: str) -> Set[str]:
        appliances = self._settings.appliances.items()
        return {peer.address for name, peer in appliances if name != admitted} | {self._settings.fixed}


def _socket_tables() -> List[str]:
    tables = []
    for path in ("/proc/net/tcp", "/proc/net/tcp6"):
        if os.path.exists(path):
            with open(path, encoding="ascii") as file:
                tables.append(file.read())
    return tables
