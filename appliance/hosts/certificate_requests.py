"""Use the certificate authority of hosts, which runs in the signer, and notice if it is replaced."""

from collections.abc import Callable
from typing import TypeVar

from appliance.channel import messages
from appliance.channel.channel import ChannelClosedError
from appliance.channel.link import Link
from appliance.channel.messages import CertificateMade
from appliance.store.host_tables import AuthorityRow, HostTables

_SECONDS = 5.0

Replaced = Callable[[bytes, bytes], object]
M = TypeVar("M", messages.AuthorityStated, messages.CertificateMade, messages.RevocationsMade)


class AuthorityError(Exception):
    """The authority rejected a request (`refused`), or did not answer."""

    def __init__(self, reason: str, *, refused: bool = False) -> None:
        super().__init__(reason)
        self.refused = refused


class Authority:
    """Sends requests; the methods raise `AuthorityError` for a rejection or a missing answer."""

    def __init__(self, signer: Link) -> None:
        self._signer = signer

    async def statement(self) -> messages.AuthorityStated:
        return await self._ask(messages.AuthorityRequest, messages.AuthorityStated)

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> messages.CertificateMade:
        """Issue a certificate; `proof` is a signature over the request by the key of `former` (PEM)."""
        return await self._ask(
            lambda number: messages.CertificateWanted(number, request, name, days, proof, former),
            messages.CertificateMade,
        )

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        rows = [messages.RevokedCertificate(serial, moment) for serial, moment in revoked]
        made = await self._ask(
            lambda number: messages.RevocationsRequest(number, rows), messages.RevocationsMade
        )
        return made.revocations

    async def _ask(self, question: Callable[[int], messages.Message], kind: type[M]) -> M:
        if self._signer.channel is None:
            raise AuthorityError("the signer is not running; it restarts within seconds: try again")
        try:
            answer = await self._signer.ask(question, _SECONDS)
        except (ChannelClosedError, TimeoutError) as error:
            raise AuthorityError("the signer did not answer: try again") from error
        if isinstance(answer, messages.CertificateRefused):
            raise AuthorityError(answer.reason, refused=True)
        if not isinstance(answer, kind):
            raise AuthorityError("the signer sent an unexpected answer")
        return answer


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
        own = (await self._signer.statement()).certificate
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
