import os
import re
from dataclasses import dataclass

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tests.support.processes import Process

_IPV4 = 4


@dataclass(frozen=True)
class EspKeys:
    """The keys of one direction. `key` is the cipher's key and, in its last four bytes, the salt (RFC 4106)."""

    spi: int
    key: bytes

    def seal(self, sequence: int, packet: bytes) -> bytes:
        head = self.spi.to_bytes(4) + sequence.to_bytes(4)
        vector = os.urandom(8)
        padding = -(len(packet) + 2) % 4
        inner = packet + bytes(range(1, padding + 1)) + bytes([padding, _IPV4])
        return head + vector + AESGCM(self.key[:-4]).encrypt(self.key[-4:] + vector, inner, head)


def initiators_keys(charon: Process) -> EspKeys:
    lines = [str(event.get("text")) for event in charon.events]
    begin = max(number for number, line in enumerate(lines) if "encryption initiator key => 36 bytes" in line)
    dump = lines[begin + 1 : begin + 4]
    matches = [re.search(r"\[CHD\].*?\d+: ((?:[0-9A-F]{2} ?)+)", line) for line in dump]
    key = b"".join(bytes.fromhex(match[1]) for match in matches if match)
    assert len(key) == 36, dump
    outbound = max(number for number, line in enumerate(lines) if "adding outbound ESP SA" in line)
    spi = next(one for line in lines[outbound:] if (one := re.search(r"SPI 0x([0-9a-f]{8}), src", line)))
    return EspKeys(int(spi[1], 16), key)
