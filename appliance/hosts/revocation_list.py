"""The list of revoked certificates as the authority signs it, for charon and for whoever asks REST."""

import asyncio
import time

from appliance.hosts.certificate_requests import Authority
from appliance.hosts.host_table import HostTable

_SIGNED_SECONDS = 60.0


class RevocationList:
    """The list as the authority signs it: anew when the table of hosts has changed, or after a minute."""

    def __init__(self, table: HostTable, authority: Authority) -> None:
        self._table = table
        self._authority = authority
        self._one_at_a_time = asyncio.Lock()
        self._state = (0, 0)
        self._signed = b""

    async def signed(self) -> bytes:
        """The list, in PEM. Raises `AuthorityError`."""
        async with self._one_at_a_time:
            state = (self._table.revision, int(time.time() // _SIGNED_SECONDS))
            if state != self._state:
                rows = self._table.listed_as_revoked()
                self._signed = await self._authority.revocations([(row.serial, row.moment) for row in rows])
                self._state = state
            return self._signed
