"""The appliances at which hosts open their tunnels. Without a pair, this appliance is the only one."""

from appliance.channel.messages import CertificateMade
from appliance.hosts.revoked_certificates import RevokedCertificates
from appliance.store.host_tables import ApplianceRow, HostTables

CERTIFICATE_DAYS = 90.0


class Appliances:
    """The appliances; with a pair (`paired`), also the `other` one."""

    paired = False

    def __init__(self, kept: HostTables, revoked: RevokedCertificates) -> None:
        """Remove and revoke the appliances in the state, because this one is single now."""
        for row in kept.appliances():
            revoked.add("", row.serial, row.expires)
            kept.forget_appliance(row.key)

    @property
    def other(self) -> ApplianceRow | None:
        return None

    async def until_introduced(self) -> None:
        """Wait a moment for the other appliance of a pair."""

    def certificate(self, key: str) -> bytes:
        del key
        return b""

    def is_served(self, pin: str) -> None:
        """Note the pin of this appliance's REST server."""

    def note_own(self, key: str) -> None: ...

    def certified(self, key: str, made: CertificateMade) -> None: ...
