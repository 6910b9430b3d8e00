import asyncio
from collections.abc import Callable
from pathlib import Path

from appliance.channel.link import Link
from appliance.channel.messages import AuthorityStated, CertificateMade
from appliance.hosts.certificate_requests import Authority, AuthorityError
from appliance.ipsec.certificate_authority import CertificateAuthority, RequestRefusedError


class NearAuthority(Authority):
    def __init__(self, directory: Path) -> None:
        super().__init__(Link(lambda _message: None))
        self._near = CertificateAuthority(directory)
        self.meanwhile: Callable[[], object] = lambda: None
        self.lists = 0
        self.trouble = ""

    async def statement(self) -> AuthorityStated:
        return AuthorityStated(0, self._near.certificate, self.trouble)

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        self.meanwhile()
        await asyncio.sleep(0)
        try:
            issued = self._near.issue(request, name, days, proof=proof, former=former)
        except RequestRefusedError as error:
            raise AuthorityError(str(error), refused=True) from error
        return CertificateMade(0, issued.certificate, issued.serial, issued.expires)

    async def revocations(self, revoked: list[tuple[str, float]]) -> bytes:
        self.lists += 1
        await asyncio.sleep(0)
        return self._near.revocations(revoked)
