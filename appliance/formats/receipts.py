"""Write and verify receipts: the collector's signed statement that it has a segment on its disk. No I/O."""

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.signatures import signature_is_valid


class SegmentReceipt(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The collector has the records from sequence `first` to `last`, sealed by checkpoint `number`.

    `time` is in nanoseconds since the epoch; hash and signature are in hexadecimal.
    """

    robot: str
    log: str
    number: int
    segment: str
    first: int
    last: int
    time: int
    signature: str = ""

    def text(self) -> bytes:
        return (
            f"rosrv fleet receipt 1\nrobot {self.robot}\nlog {self.log}\nnumber {self.number}\n"
            f"segment {self.segment}\nfirst {self.first}\nlast {self.last}\ntime {self.time}\n"
        ).encode()

    def sign(self, key: Ed25519PrivateKey) -> "SegmentReceipt":
        return msgspec.structs.replace(self, signature=key.sign(self.text()).hex())

    def is_signed(self, key: bytes) -> bool:
        try:
            return signature_is_valid(key, bytes.fromhex(self.signature), self.text())
        except ValueError:
            return False
