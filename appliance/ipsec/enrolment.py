"""The script by which a host with a one-time token makes its key, has it certified and joins. No I/O.

Invariants:

1. The private key is made on the host and never leaves it; the token is not in the script.
2. The appliance is recognised by the pin of its REST server's key, and what it answers by the fingerprint of its
   authority: whoever stands in between gets nothing and can give nothing.
"""

from dataclasses import dataclass

from appliance.ipsec.kit import filled


@dataclass(frozen=True)
class Enrolment:
    """A host that is awaited: `url` of REST, `pin` of its key (`sha256//…`), SHA-256 of the authority (hexadecimal)."""

    name: str
    url: str
    pin: str
    authority: str

    def script(self) -> str:
        """The script, for `sh`."""
        values = {"name": self.name, "url": self.url, "pin": self.pin, "authority": self.authority}
        return filled("enrol.sh", values)
