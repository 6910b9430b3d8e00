"""Control's questions to the certificate authority, which is in the signer: asked over the link, awaited."""

import asyncio
from typing import TypeVar

from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError

_SECONDS = 5.0
_Question = messages.AuthorityWanted | messages.CertificateWanted | messages.RevocationsWanted
_Answer = (
    messages.AuthorityStated
    | messages.CertificateMade
    | messages.CertificateRefused
    | messages.RevocationsMade
)

M = TypeVar("M", messages.AuthorityStated, messages.CertificateMade, messages.RevocationsMade)


class AuthorityError(Exception):
    """There is no answer: `refused` when the authority says no to this request, else it is away."""

    def __init__(self, reason: str, *, refused: bool = False) -> None:
        super().__init__(reason)
        self.refused = refused


class Authority:
    """The authority; every question raises `AuthorityError` when it is refused or not answered in time."""

    def __init__(self) -> None:
        self._link: Channel | None = None
        self._waiting: dict[int, asyncio.Future[messages.Message]] = {}
        self._number = 0

    def attach(self, link: Channel | None) -> None:
        """Ask over this link from now on; None: the signer is away."""
        self._link = link

    def received(self, message: object) -> bool:
        """Take an answer of the signer; False when it is none of ours."""
        if not isinstance(message, _Answer):
            return False
        future = self._waiting.get(message.number)
        if future is not None and not future.done():
            future.set_result(message)
        return True

    async def certificate(self) -> bytes:
        """The authority's own certificate, in PEM."""
        return (await self._ask(messages.AuthorityWanted(self._next()), messages.AuthorityStated)).certificate

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> messages.CertificateMade:
        """A certificate in this name for the key of a signing request.

        `proof`: the request's signature by the key of the certificate `former` (PEM), without which none is made.
        """
        wanted = messages.CertificateWanted(self._next(), request, name, days, proof, former)
        return await self._ask(wanted, messages.CertificateMade)

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        """The signed list (PEM) of these: serial number and moment."""
        rows = [messages.RevokedCertificate(serial, moment) for serial, moment in revoked]
        return (
            await self._ask(messages.RevocationsWanted(self._next(), rows), messages.RevocationsMade)
        ).revocations

    def _next(self) -> int:
        self._number += 1
        return self._number

    async def _ask(self, question: _Question, kind: type[M]) -> M:
        if self._link is None:
            raise AuthorityError("the signer is away; it is started again within seconds: try again")
        future: asyncio.Future[messages.Message] = asyncio.get_running_loop().create_future()
        self._waiting[question.number] = future
        try:
            self._link.send(question)
            answer = await asyncio.wait_for(future, _SECONDS)
        except (ChannelClosedError, TimeoutError) as error:
            raise AuthorityError("the signer did not answer: try again") from error
        finally:
            del self._waiting[question.number]
        if isinstance(answer, messages.CertificateRefused):
            raise AuthorityError(answer.reason, refused=True)
        if not isinstance(answer, kind):
            raise AuthorityError("the signer answered something else")
        return answer
