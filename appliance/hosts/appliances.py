"""The appliances at which hosts open their tunnels. A single appliance is the only one."""

from appliance.channel.messages import CertificateMade
from appliance.hosts.revoked_certificates import RevokedCertificates
from appliance.store.host_tables import ApplianceRow, HostTables

CERTIFICATE_DAYS = 90.0


class Appliances:
    """One of two appliances also has the `other` one (`paired`)."""

    paired = False

    def __init__(self, kept: HostTables, revoked: RevokedCertificates) -> None:
        """Remove and revoke the appliances of the state: this one is single now."""
        for row in kept.appliances():
            revoked.add("", row.serial, row.expires)
            kept.forget_appliance(row.key)

    @property
    def other(self) -> ApplianceRow | None:
        """None if it has not introduced itself."""
        return None

    async def until_introduced(self) -> None:
        """Wait a moment for the other appliance of two."""

    def certificate(self, key: str) -> bytes:
        """Return the certificate of the tunnel key, in PEM, or an empty text."""
        del key
        return b""

    def is_served(self, pin: str) -> None:
        """`pin` is that of this appliance's REST server."""

    def note_own(self, key: str) -> None: ...

    def certified(self, key: str, made: CertificateMade) -> None: ...
