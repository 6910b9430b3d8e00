"""Use the hosts' certificate authority on one of two appliances, of which perhaps only the other has its key.

The authority's certificate and its last signed list of revoked certificates are in the replicated state. So after a
takeover the tunnels of enrolled hosts open without the key. New certificates wait for it. A revoked host is shut out
anyway, because charon loads no connection for it.

A single appliance always uses its own key, and reports once that it has another one (`rosrv host authority rotate`).
"""

import datetime
from collections.abc import Callable

from appliance.base import clock
from appliance.channel.messages import CertificateMade
from appliance.hosts.certificate_requests import Authority, AuthorityError
from appliance.store.host_tables import AuthorityRow, HostTables

LIST_DAYS = 30.0  # strongSwan accepts a list for so long (`certificate_authority.REVOCATIONS_DAYS`)
_WAITS = (
    "new certificates wait, because the key of the hosts' authority is on the other appliance: make that one active"
    " (rosrv standby promote), or set ipsec.ca_passphrase_file on both, run `rosrv standby join` again and restart"
    " this one"
)


class SharedAuthority:
    """The authority of the state, by the signer of this appliance. With `shared` this is one of two appliances.

    `replaced()` is called if a single appliance has another authority than before. Every method raises
    `AuthorityError`.
    """

    def __init__(
        self,
        signer: Authority,
        kept: HostTables,
        *,
        shared: bool,
        replaced: Callable[[], object] = lambda: None,
    ) -> None:
        self._signer = signer
        self._kept = kept
        self._shared = shared
        self._replaced = replaced
        self._row = kept.authority()
        self._obstacle = ""  # as last seen

    @property
    def waits(self) -> str:
        """Return what cannot be done without the authority's key, and until when tunnels open; empty: nothing."""
        if not self._obstacle or self._row is None or not self._row.revocations:
            return self._obstacle
        end = datetime.datetime.fromtimestamp(self._row.signed + LIST_DAYS * 86_400, datetime.UTC)
        return (
            f"{self._obstacle}; tunnels open until {end:%Y-%m-%d %H:%M}Z, when the last signed list of revoked"
            " certificates ends"
        )

    async def certificate(self) -> bytes:
        """Return the authority's certificate, in PEM."""
        own = (await self._signer.stated()).certificate
        kept = self._row
        if kept is not None and (self._shared or kept.certificate == own.decode()):
            return kept.certificate.encode()
        self._save(AuthorityRow(own.decode(), "", 0.0))
        if kept is not None:
            self._replaced()
        return own

    async def obstacle(self) -> str:
        """Return why this appliance cannot issue certificates; empty if it can."""
        stated, used = await self._signer.stated(), await self.certificate()
        trouble = f" ({stated.trouble})" if stated.trouble else ""
        self._obstacle = "" if stated.certificate == used else _WAITS + trouble
        return self._obstacle

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        """Return a certificate in this name for the key of a signing request; see `Authority.issue`."""
        await self.require_key()
        return await self._signer.issue(request, name, days, proof=proof, former=former)

    async def require_key(self) -> None:
        """Raise `AuthorityError`, with the remedy, if this appliance cannot issue certificates."""
        if obstacle := await self.obstacle():
            raise AuthorityError(obstacle)

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        """Return the signed list (PEM) of these serial numbers and times; without the key, the last signed list."""
        certificate = await self.certificate()
        if obstacle := await self.obstacle():
            if self._row is None or not self._row.revocations:
                raise AuthorityError(f"no list of revoked certificates was signed yet; {obstacle}")
            return self._row.revocations.encode()
        signed = await self._signer.revocations(revoked)
        if self._shared:
            self._save(AuthorityRow(certificate.decode(), signed.decode(), clock.wall()))
        return signed

    def _save(self, row: AuthorityRow) -> None:
        self._row = row
        self._kept.save_authority(row)
