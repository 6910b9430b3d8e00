"""Use the authority of hosts' certificates, and notice if it is replaced."""

from collections.abc import Callable

from appliance.channel.messages import CertificateMade
from appliance.hosts.certificate_requests import Authority, AuthorityError
from appliance.store.host_tables import AuthorityRow, HostTables

Replaced = Callable[[bytes, bytes], object]


class StoredAuthority:
    """The authority in use; `replaced` gets the last certificate and the present one if they differ.

    Every method raises `AuthorityError`.
    """

    def __init__(
        self, signer: Authority, kept: HostTables, *, replaced: Replaced = lambda _earlier, _now: None
    ) -> None:
        self._signer = signer
        self._kept = kept
        self._replaced = replaced
        self._row = kept.authority()

    @property
    def waits(self) -> str:
        """Return the work that waits for the authority's key, and the time until which tunnels still open."""
        return ""

    async def certificate(self) -> bytes:
        own = (await self._signer.stated()).certificate
        kept = self._row
        if kept is not None and self._keeps(kept, own):
            return kept.certificate.encode()
        self._save(AuthorityRow(own.decode(), "", 0.0))
        if kept is not None:
            self._replaced(kept.certificate.encode(), own)
        return own

    def _keeps(self, kept: AuthorityRow, own: bytes) -> bool:
        return kept.certificate == own.decode()

    async def obstacle(self) -> str:
        await self.certificate()
        return ""

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        await self.require_key()
        return await self._signer.issue(request, name, days, proof=proof, former=former)

    async def require_key(self) -> None:
        if obstacle := await self.obstacle():
            raise AuthorityError(obstacle)

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        await self.certificate()
        return await self._signer.revocations(revoked)

    def _save(self, row: AuthorityRow) -> None:
        self._row = row
        self._kept.save_authority(row)
