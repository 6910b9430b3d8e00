"""Send control's requests to the certificate authority, which runs in the signer, and await the answers."""

from collections.abc import Callable
from typing import TypeVar

from appliance.channel import messages
from appliance.channel.channel import ChannelClosedError
from appliance.channel.link import Link

_SECONDS = 5.0

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

    async def stated(self) -> messages.AuthorityStated:
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
