"""Use the hosts' certificate authority on an appliance that may lack its key, because the other one has it.

Its certificate and its last signed list of revoked certificates are replicated, so tunnels open without the key.
A revoked host is shut out anyway, because charon loads no connection for it.
"""

import datetime

from appliance.base import clock
from appliance.hosts.certificate_requests import Authority, AuthorityError, StoredAuthority
from appliance.store.host_tables import AuthorityRow, HostTables

LIST_DAYS = 30.0  # strongSwan accepts a list for so long (`certificate_authority.REVOCATIONS_DAYS`)
_WAITS = (
    "new certificates wait, because the key of the hosts' authority is on the other appliance: make that one active"
    " (rosrv standby switch), or set ipsec.ca_passphrase_file on both, run `rosrv standby join` again and restart"
    " this one"
)


class SharedAuthority(StoredAuthority):
    """The certificate authority of a pair. The signer of this appliance may lack its key."""

    def __init__(self, signer: Authority, kept: HostTables) -> None:
        super().__init__(signer, kept)
        self._obstacle = ""  # as last seen

    @property
    def waits(self) -> str:
        if not self._obstacle or self._row is None or not self._row.revocations:
            return self._obstacle
        end = datetime.datetime.fromtimestamp(self._row.signed + LIST_DAYS * 86_400, datetime.UTC)
        return (
            f"{self._obstacle}; tunnels open until {end:%Y-%m-%d %H:%M}Z, when the last signed list of revoked"
            " certificates ends"
        )

    def _keeps(self, kept: AuthorityRow, own: bytes) -> bool:
        del kept, own
        return True

    async def obstacle(self) -> str:
        stated, used = await self._signer.stated(), await self.certificate()
        trouble = f" ({stated.trouble})" if stated.trouble else ""
        self._obstacle = "" if stated.certificate == used else _WAITS + trouble
        return self._obstacle

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        """Return the signed list (PEM) of these serial numbers and times; without the key, the last signed list."""
        certificate = await self.certificate()
        if obstacle := await self.obstacle():
            if self._row is None or not self._row.revocations:
                raise AuthorityError(f"no list of revoked certificates was signed yet; {obstacle}")
            return self._row.revocations.encode()
        signed = await self._signer.revocations(revoked)
        self._save(AuthorityRow(certificate.decode(), signed.decode(), clock.wall()))
        return signed
